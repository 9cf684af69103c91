"""The commands that measure accuracy and search for settings: bench, tune."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import JsonOption, SeedOption
from calibgraph.cli.terminal import print_plain, progress_bar, terminal
from calibgraph.errors import CalibrationError

if TYPE_CHECKING:
    from calibgraph.model.config import Config

bench = typer.Typer(help="Benchmarks: accuracy beside other methods.", no_args_is_help=True)

DataArgument = Annotated[
    str,
    typer.Argument(
        metavar="DATA",
        help="A simulated scenario: kitti, walkley, surround, fisheye; a dataset folder with a "
        "reference.yaml; or kitti:DIR,DIR, KITTI odometry sequences of one rig. Recordings are "
        "matched again in every draw.",
    ),
]
RotationOption = Annotated[
    float, typer.Option("--rotation-deg", min=0, help="Rotation error of every guess.")
]
TranslationOption = Annotated[
    float, typer.Option("--translation-m", min=0, help="Translation error of every guess.")
]
PresetOption = Annotated[
    str | None,
    typer.Option(
        metavar="kitti|walkley",
        help="The paper's settings, for its rows. (default: those of the data)",
    ),
]
JobsOption = Annotated[int, typer.Option(min=1, help="Processes.")]


@bench.callback()
def _bench() -> None:
    """Keep ``paper`` a subcommand: typer would merge the only command into its group."""


def paper(
    data: DataArgument,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the tables.")],
    frames: Annotated[
        str, typer.Option(metavar="N,N", help="Numbers of frames; at most as many as there are.")
    ] = "10,100",
    draws: Annotated[
        int | None,
        typer.Option(min=1, help="Draws of each N. (default: 50; of recordings 3)"),
    ] = None,
    preset: PresetOption = None,
    trf: Annotated[
        bool,
        typer.Option(
            "--trf/--no-trf", help="Run the paper's own solver too; it takes most of the time."
        ),
    ] = True,
    rotation_deg: RotationOption = 20.0,
    translation_m: TranslationOption = 1.5,
    jobs: JobsOption = 1,
    seed: SeedOption = 0,
) -> None:
    """Run the paper's experiment over many draws: tables in Markdown and JSON, and a plot.

    Every draw has new frames and a new guess, 20 degrees and 1.5 m from the truth. Rows: per-camera
    PnP and its aggregates, the paper's solver with its settings, each camera alone, ours, ours with
    a known relative pose, and ours with weights computed from the simulation's truth.
    """
    from calibgraph.evaluation.output import write_report
    from calibgraph.evaluation.paper import run_experiment
    from calibgraph.evaluation.sources import Displacement, source_from

    with checked_arguments(), progress_bar() as progress:
        source = source_from(data, Displacement(rotation_deg, translation_m))
        report = run_experiment(
            source,
            frames=_parse_counts("--frames", frames),
            draws=draws or source.default_draws,
            config=_paper_settings(source.preset if preset is None else preset, seed),
            seed=seed,
            jobs=jobs,
            trf=trf,
            progress=progress,
        )
        if report.is_empty:
            raise CalibrationError(
                f"{data}: no method found extrinsics in any draw; calibgraph calibrate reports why"
            )
        written = write_report(report, out)
    from calibgraph.cli.tables import print_bench

    print_bench(terminal(), report)
    for path in written:
        print_plain(terminal(), f"{path}: written")


def _paper_settings(name: str, seed: int) -> Config:
    """The paper's settings: the preset kitti or walkley.

    Raises:
        ValueError: if the preset is unknown, or auto.
    """
    from calibgraph.model.config import preset

    if name == "auto":
        raise ValueError("--preset auto: give the paper's settings, kitti or walkley")
    return preset(name).changed(seed=seed)


def _parse_counts(option: str, text: str) -> list[int]:
    try:
        found = [int(part) for part in text.split(",")]
    except ValueError:
        found = []
    if not found or min(found) < 1:
        raise ValueError(f"{option} {text}: give whole numbers from 1 on, like 10,100")
    return found


def _parse_numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} {text}: give numbers, like 0.5,1,2") from None


_CANDIDATES = "Candidates"


def tune(
    data: DataArgument,
    out: Annotated[Path, typer.Option(metavar="FILE.yaml", help="Settings to write.")],
    samples: Annotated[int, typer.Option(min=1, help="Candidates to try.")] = 50,
    frames: Annotated[int, typer.Option(min=1, help="Frames of a draw.")] = 10,
    draws: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Draws for tuning, and as many for the test. (default: 5; of recordings 3)",
        ),
    ] = None,
    preset: PresetOption = None,
    prior_weight: Annotated[
        str, typer.Option("--lambda", metavar="X,X", help="lambda.", rich_help_panel=_CANDIDATES)
    ] = "0,0.1,0.5,1,2,5,10",
    relative_prior_weight: Annotated[
        str, typer.Option("--mu", metavar="X,X", help="mu.", rich_help_panel=_CANDIDATES)
    ] = "0,1,2,5,10,20",
    loss_scale_px: Annotated[
        str,
        typer.Option(
            "--delta", metavar="X,X", help="delta, in pixels.", rich_help_panel=_CANDIDATES
        ),
    ] = "1,2,4,8,16",
    gate_px: Annotated[
        str,
        typer.Option("--tau", metavar="X,X", help="tau, in pixels.", rich_help_panel=_CANDIDATES),
    ] = "2,3,5,8,16,32",
    rotation_deg: RotationOption = 20.0,
    translation_m: TranslationOption = 1.5,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Search for lambda, mu, delta and tau at random, as the paper does, and test the best.

    The score is E_R / 1 deg + E_t / 10 cm, the mean over cameras and draws. Tuning and test draws
    share no frame. FILE.yaml is read by --config.
    """
    from calibgraph.evaluation.sources import Displacement, source_from
    from calibgraph.evaluation.tune import Candidates, tune

    with checked_arguments(), progress_bar() as progress:
        candidates = Candidates(
            _parse_numbers("--lambda", prior_weight),
            _parse_numbers("--mu", relative_prior_weight),
            _parse_numbers("--delta", loss_scale_px),
            _parse_numbers("--tau", gate_px),
        )
        source = source_from(data, Displacement(rotation_deg, translation_m))
        tuned = tune(
            source,
            base=_paper_settings(source.preset if preset is None else preset, seed),
            frames=frames,
            samples=samples,
            draws=draws or min(5, source.default_draws),
            candidates=candidates,
            seed=seed,
            progress=progress,
        )
    if not math.isfinite(tuned.best.tuning):
        raise CalibrationError(
            f"{data}: no candidate found extrinsics in every draw; calibgraph calibrate "
            "reports why; more --frames may help"
        )
    tuned.save(out)
    if as_json:
        from calibgraph.report.as_json import print_json

        print_json(tuned.to_mapping())
    else:
        from calibgraph.cli.tables import print_tuned

        print_tuned(terminal(), tuned)
        print_plain(terminal(), f"{out}: written")
