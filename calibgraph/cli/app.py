"""The command line: each command loads, calls one library function, and prints.

Human output goes to stderr, machine output (``--json``) to stdout. Exit codes: 0 done (PASS or
WARN), 1 the calibration FAILed (its files are written, and say so), 2 bad input (one line).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli.benchmark import bench, tune
from calibgraph.cli.choices import dataset_of, matcher_of, settings_of, terms_of
from calibgraph.cli.learned import train, weights
from calibgraph.cli.options import (
    BatchOption,
    BootstrapOption,
    ConfigOption,
    DatasetArgument,
    DeviceOption,
    EstimateOption,
    FramesOption,
    HalfOption,
    IterationsOption,
    JsonOption,
    MatcherOption,
    OcclusionOption,
    OutOption,
    PresetOption,
    RigArgument,
    RigOption,
    SearchDegOption,
    SearchMetresOption,
    SeedOption,
    TermsOption,
    TimeLimitOption,
    WeightsOption,
)
from calibgraph.cli.simulate import simulate
from calibgraph.cli.support import checked_arguments, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.io.dataset import Dataset
    from calibgraph.model.calibration import Calibration

app = typer.Typer(
    help="Calibrate all cameras around a LiDAR at once, from ordinary driving data.\n\n"
    "T_a_b maps coordinates in b to coordinates in a: p_camera = T_camera_lidar * p_lidar. "
    "Wherever a RIG, ESTIMATE or REFERENCE is asked for, a rig file, a result (file or folder), "
    "a dataset folder (its rig.yaml) or a KITTI odometry sequence folder serves.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"calibgraph {version('calibgraph')}")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options before the command; ``--debug`` is read by :func:`main`."""


@app.command()
def calibrate(
    dataset: DatasetArgument,
    rig: RigOption = None,
    matcher: MatcherOption = "structure",
    frames: FramesOption = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    terms: TermsOption = "full",
    out: OutOption = Path("calibration"),
    seed: SeedOption = 0,
    bootstrap: BootstrapOption = None,
    time_limit_s: TimeLimitOption = None,
    as_json: JsonOption = False,
    search_deg: SearchDegOption = None,
    search_m: SearchMetresOption = None,
    weights: WeightsOption = None,
    estimate: EstimateOption = None,
    device: DeviceOption = "auto",
    iterations: IterationsOption = None,
    half_resolution: HalfOption = None,
    occlusion_filter: OcclusionOption = None,
    batch: BatchOption = None,
) -> None:
    """From images and clouds to one calibration of all cameras, with pictures and a report."""
    from calibgraph.files import require_place_for_folder
    from calibgraph.pipeline import calibrate
    from calibgraph.report import write_report
    from calibgraph.report.overlay import write_overlays

    require_place_for_folder(out)
    with checked_arguments():
        settings, checked_terms = settings_of(config, preset, seed, bootstrap), terms_of(terms)
        chosen = matcher_of(
            matcher,
            weights,
            seed=seed,
            search_deg=search_deg,
            search_m=search_m,
            chosen_frames=frames is not None,
            device=device,
            estimate=estimate,
            iterations=iterations,
            half_resolution=half_resolution,
            occlusion_filter=occlusion_filter,
            batch=batch,
        )
    data = dataset_of(dataset, rig, frames)
    with progress_bar() as progress:
        result = calibrate(
            data,
            matcher=chosen,
            config=settings,
            terms=checked_terms,
            time_limit_s=time_limit_s,
            progress=progress,
        )
        written = [result.save(out), out / "correspondences.parquet"]
        shown = data.frames[len(data.frames) // 2]
        written += write_overlays(shown, result.initial_rig, result.rig, out, mark=_mark(result))
        written.append(write_report(result, out / "report.html"))
    _say_frames(len(result.frames), data)
    _finish(result, written, as_json)


@app.command()
def match(
    dataset: DatasetArgument,
    rig: RigOption = None,
    matcher: MatcherOption = "structure",
    frames: FramesOption = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Table to write, .parquet or .csv.")
    ] = Path("correspondences.parquet"),
    seed: SeedOption = 0,
    time_limit_s: TimeLimitOption = None,
    as_json: JsonOption = False,
    search_deg: SearchDegOption = None,
    search_m: SearchMetresOption = None,
    weights: WeightsOption = None,
    estimate: EstimateOption = None,
    device: DeviceOption = "auto",
    iterations: IterationsOption = None,
    half_resolution: HalfOption = None,
    occlusion_filter: OcclusionOption = None,
    batch: BatchOption = None,
) -> None:
    """Find correspondences and write them as a table; exit 1 if a camera was not found."""
    from calibgraph.files import require_place_for_file
    from calibgraph.rounds import match_in_rounds

    require_place_for_file(out)
    with checked_arguments():
        if out.suffix not in (".parquet", ".csv"):
            raise ValueError(f"--out {out}: the table's name must end in .parquet or .csv")
        chosen = matcher_of(
            matcher,
            weights,
            seed=seed,
            search_deg=search_deg,
            search_m=search_m,
            chosen_frames=frames is not None,
            device=device,
            estimate=estimate,
            iterations=iterations,
            half_resolution=half_resolution,
            occlusion_filter=occlusion_filter,
            batch=batch,
        )
    data = dataset_of(dataset, rig, frames)
    with progress_bar() as progress:
        run = match_in_rounds(data, matcher=chosen, time_limit_s=time_limit_s, progress=progress)
    table = run.correspondences
    table.save(out)
    _say_frames(len(run.dataset.frames), data)
    missed = list(table.findings.missed)
    if as_json:
        from calibgraph.report.as_json import print_json

        print_json({"out": str(out), "matches": table.counts(), "missed": missed})
    else:
        counts = ", ".join(f"{name} {count}" for name, count in table.counts().items())
        terminal().print(f"{out}: {len(table)} correspondences ({counts})")
    if missed:
        terminal().print(
            f"not found: {', '.join(missed)}: what is matched from the guess will FAIL when solved",
            soft_wrap=True,
        )
        raise typer.Exit(1)


@app.command()
def solve(
    rig: RigArgument,
    correspondences: Annotated[
        Path,
        typer.Argument(
            metavar="CORRESPONDENCES",
            help="Table, .parquet or .csv; a .parquet may be larger than memory.",
        ),
    ],
    terms: TermsOption = "full",
    preset: PresetOption = None,
    config: ConfigOption = None,
    out: OutOption = Path("calibration"),
    seed: SeedOption = 0,
    bootstrap: BootstrapOption = None,
    as_json: JsonOption = False,
) -> None:
    """From a table of correspondences to one calibration of all cameras, with a report."""
    from calibgraph.files import require_place_for_folder, sha256
    from calibgraph.io.rigs import load_rig
    from calibgraph.pipeline import solve
    from calibgraph.report import write_report

    require_place_for_folder(out)
    with checked_arguments():
        settings, checked_terms = settings_of(config, preset, seed, bootstrap), terms_of(terms)
    result = solve(load_rig(rig), correspondences, settings, checked_terms)
    result = result.with_inputs({str(correspondences): sha256(correspondences)})
    written = [result.save(out), write_report(result, out / "report.html")]
    _finish(result, written, as_json)


@app.command()
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
            help="Where the images and clouds are now, if they have moved; may come again: the "
            "same folders in the same order.",
        ),
    ] = None,
) -> None:
    """Write what is known of a result as one HTML page that opens without a network."""
    from calibgraph.files import require_place_for_file
    from calibgraph.io.calibrations import load_calibration
    from calibgraph.io.dataset import load_dataset
    from calibgraph.report import with_files_of, write_report

    if out is not None:
        require_place_for_file(out, ".html", ".htm")
    loaded = load_calibration(result)
    if dataset:
        loaded = with_files_of(loaded, load_dataset(dataset, loaded.rig))
    folder = result if result.is_dir() else result.parent
    path = write_report(loaded, out or folder / "report.html")
    terminal().print(
        f"{path}: written; the verdict is {loaded.verdict.status}", markup=False, soft_wrap=True
    )


@app.command()
def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE", help="What to judge.")],
    reference: Annotated[Path, typer.Argument(metavar="REFERENCE", help="What to judge it by.")],
    as_json: JsonOption = False,
) -> None:
    """Compare an estimate with a reference: the paper's metrics, per camera and per pair."""
    from calibgraph.io.rigs import load_rig, rig_file
    from calibgraph.model.metrics import evaluate

    errors = evaluate(load_rig(estimate), load_rig(reference))
    if as_json:
        from calibgraph.report.as_json import print_json

        print_json(errors.to_mapping())
    else:
        from calibgraph.cli.tables import print_evaluation

        print_evaluation(terminal(), errors, rig_file(estimate), rig_file(reference))


@app.command()
def perturb(
    rig: RigArgument,
    out: Annotated[Path, typer.Option(metavar="RIG", help="Rig file to write.")],
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
    from calibgraph.files import require_place_for_file
    from calibgraph.io.rigs import REFERENCE_FILE, load_rig, rig_file
    from calibgraph.model.perturbation import perturb

    require_place_for_file(out, ".yaml", ".yml")
    given = load_rig(rig)
    with checked_arguments():
        if out.exists() and (out.name == REFERENCE_FILE or out.samefile(rig_file(rig))):
            raise ValueError(f"--out {out}: that is a truth, or what is read; choose another name")
        moved = perturb(
            given,
            rotation_deg=rotation_deg,
            translation_m=translation_m,
            seed=seed,
            uniform=uniform,
        )
    moved.save(out)
    terminal().print(f"{out}: {len(moved.cameras)} cameras displaced (seed {seed})")


app.command()(simulate)
app.command()(weights)
app.command()(train)
app.add_typer(bench, name="bench")
app.command()(tune)


@app.command()
def track(
    rig: RigArgument,
    source: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE...",
            help="Table of correspondences (.parquet, .csv), a growing folder of them, or - for "
            "standard input (an Arrow IPC stream, or a JSON line per frame). With --matcher: "
            "dataset folders or KITTI sequences of one rig, as one drive.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Folder for the state, the result and a picture. State that lies there is gone "
            "on with.",
        ),
    ] = Path("tracking"),
    every: Annotated[int, typer.Option(min=1, help="Take every N-th frame only.")] = 1,
    follow: Annotated[
        bool, typer.Option("--follow", help="Wait for new files in the folder, until stopped.")
    ] = False,
    matcher: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Match the frames of a dataset: structure or cmrnext."),
    ] = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    seed: SeedOption = 0,
    weights: WeightsOption = None,
    device: DeviceOption = "auto",
) -> None:
    """Keep all cameras calibrated while driving: a frame in, a line of JSON out.

    Each line on standard output is one update: estimates, covariances, verdicts, and events (what
    moved, since when, how far). It is printed once the update is on disk: after a crash, or kill
    -9, the same command goes on where it stopped; the last line from before may come again. SIGTERM
    and Ctrl-C finish the update at hand.
    """
    from calibgraph.files import require_place_for_folder
    from calibgraph.io.rigs import load_rig
    from calibgraph.tracking.command import Tracking, track

    require_place_for_folder(out)
    with checked_arguments():
        settings = settings_of(config, preset, seed)
        chosen = matcher_of(matcher, weights, seed=seed, device=device) if matcher else None
        if chosen is None and weights:
            raise ValueError("--weights is for --matcher cmrnext only")
        if chosen is None and len(source) > 1:
            raise ValueError(f"{len(source)} sources given; several go with --matcher only")
    console = terminal()
    wanted = Tracking(
        rig=load_rig(rig),
        config=settings,
        out=out,
        every=every,
        follow=follow,
        matcher=chosen,
    )
    result, written = track(
        wanted,
        source,
        notify=lambda text: console.print(text, soft_wrap=True, markup=False, highlight=False),
    )
    from calibgraph.cli.tables import print_result

    print_result(console, result, written)
    if result.verdict.status == "FAIL":
        raise typer.Exit(1)


def main() -> None:
    """Run the command line; errors in the data become one line on stderr and exit code 2."""
    from calibgraph.errors import CalibrationError

    sys.argv[1:] = list(_each_with_its_option(sys.argv[1:]))
    try:
        code = app(standalone_mode=False) or 0
        if code == _INTERRUPTED:  # by Ctrl-C, as typer puts it
            raise KeyboardInterrupt
        sys.exit(code)
    except (CalibrationError, OSError, _UsageError) as error:
        if "--debug" in sys.argv:
            raise
        if str(error) or not isinstance(error, _UsageError):  # else the help has been printed
            print(f"calibgraph: {_one_line(error)}", file=sys.stderr)
        sys.exit(2)
    except (typer.Abort, KeyboardInterrupt):
        print("calibgraph: interrupted", file=sys.stderr)
        sys.exit(_INTERRUPTED)


_INTERRUPTED = 130
_WEIGHTS_SUFFIXES = (".tar", ".pt", ".pth", ".safetensors")


def _each_with_its_option(arguments: list[str]) -> Iterator[str]:
    """Spell out ``--weights a.tar b.tar`` as ``--weights a.tar --weights b.tar``."""
    listing, before = False, ""
    for argument in arguments:
        if before == "--weights" or argument.startswith("--weights="):
            listing = True
        elif listing and argument.lower().endswith(_WEIGHTS_SUFFIXES):
            yield "--weights"
        else:
            listing = False
        yield argument
        before = argument


_UsageError: type[Exception] = typer.BadParameter.__base__ or Exception


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    text = error.format_message() if hasattr(error, "format_message") else str(error)
    more = "; see calibgraph --help" if isinstance(error, _UsageError) else ""
    return " ".join(text.split()).removesuffix(".") + more


def _say_frames(used: int, data: Dataset) -> None:
    """Say so if not all frames were matched."""
    if used < len(data.frames):
        text = f"{used} of {len(data.frames)} frames, evenly spread; --frames takes others"
        terminal().print(text, soft_wrap=True, highlight=False)


def _mark(result: Calibration) -> str:
    """What every picture of a result that cannot be used says."""
    return "FAIL, do not use: " if result.verdict.status == "FAIL" else ""


def _finish(result: Calibration, written: list[Path], as_json: bool) -> None:
    """Print a result and exit with the code of its verdict."""
    if as_json:
        from calibgraph.report.as_json import print_json, result_summary

        print_json(result_summary(result, written))
    else:
        from calibgraph.cli.tables import print_result

        print_result(terminal(), result, written)
    if result.verdict.status == "FAIL":
        raise typer.Exit(1)
