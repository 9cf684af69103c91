"""The commands about a result or a rig: report, evaluate, perturb."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import JsonOption, SeedOption
from calibgraph.cli.terminal import print_plain, terminal


def report(
    result: Annotated[
        Path, typer.Argument(metavar="DIR", help="Result: its folder, or its calibration.yaml.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Page to write. (default: DIR/report.html)"),
    ] = None,
    dataset: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DATASET",
            help="Where the images and clouds are now, if they have moved; repeat it for several "
            "folders, in the order in which they were calibrated.",
        ),
    ] = None,
) -> None:
    """Write a result as one HTML page that opens without a network."""
    from calibgraph.io.calibrations import load_calibration
    from calibgraph.io.dataset import load_dataset
    from calibgraph.model.result_files import REPORT_FILE
    from calibgraph.report import relocate_frames, write_report

    loaded = load_calibration(result)
    if dataset:
        loaded = relocate_frames(loaded, load_dataset(dataset, loaded.rig))
    folder = result if result.is_dir() else result.parent
    path = write_report(loaded, out or folder / REPORT_FILE)
    print_plain(terminal(), f"{path}: written; the verdict is {loaded.verdict.status}")


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE", help="Rig to evaluate.")],
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="Rig to compare with.")],
    as_json: JsonOption = False,
) -> None:
    """Compare an estimate with a reference: the paper's metrics, per camera and per pair.

    Of a reference with error bars, as `calibgraph pick` writes it, in standard deviations as well.
    """
    from calibgraph.io.calibrations import error_bars
    from calibgraph.io.rigs import load_rig, rig_file
    from calibgraph.model.metrics import evaluate

    path = rig_file(estimate)
    errors = evaluate(load_rig(estimate), load_rig(reference), error_bars(path))
    if as_json:
        from calibgraph.report.as_json import print_json

        print_json(errors.to_mapping())
    else:
        from calibgraph.cli.tables import print_evaluation

        print_evaluation(terminal(), errors, path, rig_file(reference))


def perturb(
    rig: Annotated[
        Path, typer.Argument(metavar="RIG", help="Rig to displace, usually a reference.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="FILE.yaml", help="Rig file to write: the displaced guess.")
    ],
    rotation_deg: Annotated[float, typer.Option(min=0, help="Angle, about a random axis.")] = 20.0,
    translation_m: Annotated[
        float, typer.Option(min=0, help="Length, in a random direction.")
    ] = 1.5,
    seed: SeedOption = 0,
    uniform: Annotated[
        bool, typer.Option("--uniform", help="Per axis, uniform within +- the values.")
    ] = False,
) -> None:
    """Displace every camera at random, T_delta * T_camera_lidar: the paper's initial guesses."""
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.perturbation import perturb
    from calibgraph.outputs import yaml_mark

    given = load_rig(rig)
    with checked_arguments():
        displaced = perturb(
            given,
            rotation_deg=rotation_deg,
            translation_m=translation_m,
            seed=seed,
            uniform=uniform,
        )
    displaced.save(out, first_line=yaml_mark("perturb"))
    print_plain(terminal(), f"{out}: {len(displaced.cameras)} cameras displaced (seed {seed})")
