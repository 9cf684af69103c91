"""The command that measures accuracy: bench."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.options import SeedOption
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
