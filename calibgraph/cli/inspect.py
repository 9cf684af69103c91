"""The commands about a result, a rig or a dataset: report, view, evaluate, perturb, doctor."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli import options, outputs
from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.option_groups import DatasetOptions
from calibgraph.cli.options import JsonOption, SeedOption
from calibgraph.cli.terminal import print_json, print_plain, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.model.calibration import Calibration


_MOVED = typer.Option(
    metavar="DATASET",
    help="Where the images and clouds are now, if they have moved; repeat it for several folders, "
    "in the order in which they were calibrated.",
)


def _load_result(result: Path, dataset: list[Path] | None) -> Calibration:
    """A result, with its frames where they are now."""
    from calibgraph.io.calibrations import load_calibration
    from calibgraph.io.dataset import load_dataset
    from calibgraph.report.frames import relocate_frames

    loaded = load_calibration(result)
    if not dataset:
        return loaded
    with checked_arguments():
        return relocate_frames(loaded, load_dataset(dataset, loaded.rig))


def report(
    result: Path,
    out: Annotated[Path | None, outputs.PAGE] = None,
    dataset: Annotated[list[Path] | None, _MOVED] = None,
) -> None:
    """Write a result as one HTML page that opens without a network.

    Args:
        out (FILE): Page to write. (default: DIR/report.html)
    """
    from calibgraph.model.result_files import REPORT_FILE
    from calibgraph.report.html import write_report

    loaded = _load_result(result, dataset)
    folder = result if result.is_dir() else result.parent
    path = write_report(loaded, out or folder / REPORT_FILE)
    print_plain(terminal(), f"{path}: written; the verdict is {loaded.verdict.status}")


def evaluate(
    estimate: Path,
    reference: Path,
    as_json: JsonOption = False,
) -> None:
    """Compare an estimate with a reference: the paper's metrics, per camera and per pair.

    Of a reference with error bars, as `calibgraph pick` writes it, in standard deviations as well.

    Args:
        estimate (ESTIMATE): Rig to evaluate.
        reference (REFERENCE): Rig to compare with.
    """
    from calibgraph.io.calibrations import error_bars
    from calibgraph.io.rigs import load_rig, rig_file
    from calibgraph.model.metrics import evaluate

    path = rig_file(estimate)
    errors = evaluate(load_rig(estimate), load_rig(reference), error_bars(path))
    if as_json:
        print_json(errors.to_mapping())
    else:
        from calibgraph.cli.tables import print_evaluation

        print_evaluation(terminal(), errors, path, rig_file(reference))


def perturb(
    rig: Path,
    out: Annotated[Path, typer.Option(), outputs.rig_of("perturb")],
    rotation_deg: Annotated[float, typer.Option(min=0)] = 20.0,
    translation_m: Annotated[float, typer.Option(min=0)] = 1.5,
    seed: SeedOption = 0,
    uniform: bool = False,
) -> None:
    """Displace every camera at random, T_delta * T_camera_lidar: the paper's initial guesses.

    Args:
        rig (RIG): Rig to displace, usually a reference.
        out (FILE.yaml): Rig file to write: the displaced guess.
        rotation_deg: Angle, about a random axis.
        translation_m: Length, in a random direction.
        uniform: Per axis, uniform within +- the values.
    """
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


def view(
    result: Path,
    rerun: Annotated[Path | None, outputs.RERUN] = None,
    mcap: Annotated[Path | None, outputs.MCAP] = None,
    dataset: Annotated[list[Path] | None, _MOVED] = None,
) -> None:
    """Write a result for viewers: clouds, images and projected points, before and after.

    Args:
        rerun (FILE.rrd): Recording for Rerun: `rerun FILE.rrd` shows it.
        mcap (FILE.mcap): Recording for Foxglove.
    """
    from calibgraph.errors import CalibrationError
    from calibgraph.view.mcap_file import write_mcap
    from calibgraph.view.rerun_file import write_rerun

    if rerun is None and mcap is None:
        raise CalibrationError("nothing to write; give --rerun FILE.rrd, --mcap FILE.mcap or both")
    loaded = _load_result(result, dataset)
    os.environ.setdefault("RUST_LOG", "off")  # Rerun logs what our line states
    written = []
    with progress_bar("reading") as progress:
        if rerun is not None:
            written.append(write_rerun(loaded, rerun, progress=progress))
        if mcap is not None:
            written.append(write_mcap(loaded, mcap, progress=progress))
    for path in written:
        print_plain(terminal(), f"{path}: written; the verdict is {loaded.verdict.status}")


def doctor(
    dataset: list[Path],
    chosen: DatasetOptions,
    out: Annotated[Path | None, outputs.PICTURES] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Examine a dataset before it is calibrated: what is there, what to fix; exit 1 if anything.

    Args:
        out (DIR): Folder for guess_CAMERA.png: the guess on an image of each camera.
    """
    from calibgraph.doctor import diagnose
    from calibgraph.files import require_place_for_folder
    from calibgraph.io.rigs import load_rig

    if out is not None:
        require_place_for_folder(out)
    bag = chosen.bag
    with checked_arguments(), progress_bar("reading"):
        guess = load_rig(chosen.rig) if chosen.rig else None
        found = diagnose(dataset, guess, frames=chosen.frames, bag=bag, pictures=out)
    if as_json:
        print_json(found.to_mapping())
    else:
        for finding in found.findings:
            print_plain(terminal(), f"{finding.level:8} {finding.text}")
        for path in found.pictures:
            print_plain(terminal(), f"{path}: written")
        if all(finding.level == "note" for finding in found.findings):
            print_plain(terminal(), "no faults; next: calibgraph calibrate")
    if not found.healthy:
        raise typer.Exit(1)
