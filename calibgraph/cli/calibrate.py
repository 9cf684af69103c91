"""The commands that make a calibration: calibrate, match, solve; and track, while driving."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import typer
from typer import Argument, Option

import calibgraph
from calibgraph.cli import options
from calibgraph.cli.options import (
    bag_settings,
    checked_arguments,
    dataset_from,
    matcher_from,
    time_limit_of,
)  # fmt: skip
from calibgraph.cli.terminal import elapsed_s, print_line, progress_bar, terminal
from calibgraph.stdout import print_json, require_stdout

TABLE_SUFFIXES = (".parquet", ".csv")


def calibrate(
    dataset: options.Datasets,
    out: options.ResultFolder = Path("calibration"),
    rig: options.RigFile = None,
    frames: options.Frames = None,
    every_s: options.EveryS = None,
    topic: options.Topic = None,
    motion: options.Motion = None,
    interval_s: options.IntervalS = None,
    matcher: options.MatcherName = "structure",
    weights: options.Weights = None,
    time_limit_s: options.TimeLimitS = None,
    search_deg: options.SearchDeg = None,
    search_m: options.SearchM = None,
    estimate: options.Estimate = None,
    of: options.Of = None,
    config: options.ConfigFile = None,
    as_json: options.JsonOption = False,
) -> None:
    """Calibrate all cameras jointly from images and clouds, with pictures and a report."""
    from calibgraph.cli.settings import read_settings
    from calibgraph.memory import keep_freed_memory
    from calibgraph.model.result_files import require_result_folder

    keep_freed_memory()
    require_result_folder(out, [*dataset, *_rig_files(rig)])
    from calibgraph.report.html import write_result

    with checked_arguments():
        settings, rare = read_settings(config, estimate=estimate, of=of)
        chosen = matcher_from(
            matcher, weights, seed=settings.seed, all_frames=bool(frames or every_s),
            of_cmrnext=rare.of_cmrnext, search_deg=search_deg, search_m=search_m
        )  # fmt: skip
    bag = bag_settings(config, topic, every_s=every_s, motion=motion)
    data = dataset_from(dataset, rig, frames, bag, interval_s=interval_s)
    with progress_bar() as progress:
        result = calibgraph.calibrate(
            data, matcher=chosen, config=settings, terms=rare.terms,
            time_limit_s=time_limit_of(matcher, time_limit_s), progress=progress
        )  # fmt: skip
        result = _warned_of_same_data(result, rig)
        written = write_result(result, out)
    checks = (check for of in result.camera_verdicts.values() for check in of.checks)
    copies = next((check.value for check in checks if check.name == "copies"), None)
    _print_frames_used(len(result.frames), data, int(copies or 0))
    _print_and_exit(result, written, as_json=as_json)


def match(
    dataset: options.Datasets,
    out: Path = Option(
        Path("correspondences.parquet"), metavar="FILE", help="Table to write, .parquet or .csv."
    ),
    rig: options.RigFile = None,
    frames: options.Frames = None,
    every_s: options.EveryS = None,
    topic: options.Topic = None,
    motion: options.Motion = None,
    interval_s: options.IntervalS = None,
    matcher: options.MatcherName = "structure",
    weights: options.Weights = None,
    time_limit_s: options.TimeLimitS = None,
    search_deg: options.SearchDeg = None,
    search_m: options.SearchM = None,
    seed: options.SeedOrConfig = None,
    config: options.ConfigFile = None,
    as_json: options.JsonOption = False,
    force: options.Force = False,
) -> None:
    """Find correspondences and write them as a table; exit 1 if a camera was not found."""
    from calibgraph.cli.settings import read_settings
    from calibgraph.files import require_new_file
    from calibgraph.pipeline import find_lidars
    from calibgraph.rounds import match_in_rounds

    require_new_file(out, *TABLE_SUFFIXES, force=force)
    with checked_arguments():
        settings, rare = read_settings(config, seed=seed)
        chosen = matcher_from(
            matcher, weights, seed=settings.seed, all_frames=bool(frames or every_s),
            of_cmrnext=rare.of_cmrnext, search_deg=search_deg, search_m=search_m
        )  # fmt: skip
    bag = bag_settings(config, topic, every_s=every_s, motion=motion)
    data = dataset_from(dataset, rig, frames, bag, interval_s=interval_s)
    data = data.at_instants() if settings.instant_clouds else data
    limit_s = time_limit_of(matcher, time_limit_s)
    with progress_bar() as progress:
        if data.rig.require_cameras().other_lidars:  # as of calibrate
            data, *_ = find_lidars(data, data.rig, chosen, settings, progress=progress)
        run = match_in_rounds(data, matcher=chosen, time_limit_s=limit_s, progress=progress)
        run.correspondences.save(out)
    _print_frames_used(len(run.dataset.frames), data, len(run.copies))
    counts, missed = run.correspondences.counts(), list(run.correspondences.findings.missed)
    if as_json:
        print_json({"out": str(out), "matches": counts, "missed": missed})
    else:
        of_each = ", ".join(f"{name} {count}" for name, count in counts.items())
        print_line(f"{out}: {len(run.correspondences)} correspondences ({of_each})")
    if missed:
        lost = f"not found: {', '.join(missed)}"
        print_line(f"{lost}: a solve of their matches from the guess will FAIL")
        raise typer.Exit(1)


def solve(
    rig: Path = Argument(..., metavar="RIG", help="Rig with the initial guess."),
    correspondences: Path = Argument(
        ..., metavar="CORRESPONDENCES", help="Table, .parquet or .csv."
    ),
    out: options.ResultFolder = Path("calibration"),
    terms: str | None = Option(
        None, metavar="full|reprojection|priors|stage1", help="Of the objective. (default: full)"
    ),
    estimate: options.Estimate = None,
    of: options.Of = None,
    camera_matches: Path | None = Option(
        None, metavar="FILE", help="What cameras have in common: the table of a result."
    ),
    common_deg: float | None = Option(
        None, metavar="DEG", min=0, help="Error that all frames share. (default: the table's)"
    ),
    common_cm: float | None = Option(None, metavar="CM", min=0, help="Likewise, of the position."),
    print_graph: bool = Option(
        False, "--print-graph", callback=require_stdout, help="Print every factor."
    ),
    config: options.ConfigFile = None,
    as_json: options.JsonOption = False,
) -> None:
    """Calibrate all cameras jointly from a table of correspondences, with a report."""
    from calibgraph.cli.settings import read_settings
    from calibgraph.files import sha256
    from calibgraph.model.result_files import require_result_folder
    from calibgraph.report.html import write_result

    matches = [] if camera_matches is None else [camera_matches]
    require_result_folder(out, [*_rig_files(rig), correspondences, *matches])
    with checked_arguments():
        settings, rare = read_settings(
            config, terms=terms, estimate=estimate, of=of, common_deg=common_deg,
            common_cm=common_cm
        )  # fmt: skip
        if print_graph and as_json:
            raise ValueError("--print-graph and --json both print; choose one")
    with progress_bar("solving"), checked_arguments():
        seen = None if camera_matches is None else calibgraph.load_camera_matches(camera_matches)
        result = calibgraph.solve(
            calibgraph.load_rig(rig), correspondences, settings, rare.terms, camera_matches=seen
        )
        result = replace(result, inputs={str(correspondences): sha256(correspondences)})
        result = _warned_of_same_data(result, rig)
        written = write_result(result, out)
    if print_graph:
        print(result.graph)
        raise typer.Exit(1 if result.verdict.status == "FAIL" else 0)
    _print_and_exit(result, written, as_json=as_json)


def _rig_files(rig: Path | None) -> list[Path]:
    """The file of a rig, if one is given."""
    from calibgraph.io.rigs import find_rig_file

    return [] if rig is None else [find_rig_file(rig) or rig]


def _warned_of_same_data(
    result: calibgraph.Calibration, rig: Path | None
) -> calibgraph.Calibration:
    """With a warning if what was estimated has a prior that is from the same data."""
    from calibgraph.io.calibrations import stated_result
    from calibgraph.io.rigs import rig_file

    stated = stated_result(rig_file(rig)) if rig and result.config.estimate else None
    if stated is None or stated.hashes.isdisjoint(result.inputs.values()):
        return result
    text = (
        f"{rig} was made from the same data, which count twice in the estimates of lens and clock: "
        "their sigmas are too small. Give the rig that you began with"
    )
    logging.getLogger(__name__).warning(text)
    return replace(result, warnings=(*result.warnings, text))


def _print_frames_used(used: int, data: calibgraph.Dataset, copies: int) -> None:
    """Print how many frames were matched, unless all were."""
    text = f"{used} of {len(data.frames)} frames"
    if used + copies < len(data.frames):
        text += ", spread over them, the clearest of neighbours; --frames takes others"
    if copies:
        text += f"; {copies} {'copies' if copies > 1 else 'copy'} left out"
    if used < len(data.frames):
        print_line(text)


def _print_and_exit(result: calibgraph.Calibration, written: list[Path], *, as_json: bool) -> None:
    """Print a result; exit 1 if it is FAIL."""
    if as_json:
        from calibgraph.report.as_json import result_summary

        print_json(result_summary(result, written))
    else:
        from calibgraph.report.tables import print_result

        print_result(terminal(), result, written, elapsed_s())
    if result.verdict.status == "FAIL":
        raise typer.Exit(1)


def track(
    rig: Path = Argument(..., metavar="RIG", help="Rig with the initial guess."),
    source: str = Argument(
        ...,
        metavar="TABLE",
        help="Table of correspondences (.parquet, .csv), or - for standard input (a JSON line per "
        "frame).",
    ),
    out: Path = Option(
        Path("tracking"),
        metavar="DIR",
        help="Folder for the state and the result. A state in it is resumed.",
    ),
    config: options.ConfigFile = None,
    seed: options.SeedOrConfig = None,
) -> None:
    """Keep all cameras calibrated while driving: one frame in, one line of JSON out.

    Each line on standard output is one update: estimates, covariances, verdicts, and events (what
    moved, since when, how far). It is printed once the update is on disk: after a crash or kill -9
    the same command resumes there, and may print the last lines again. SIGTERM and Ctrl-C finish
    the current update first.

    Frames of one place (within some 20 m) share errors: name it in each line ("place") or list the
    frames of each in the table ("places"). Otherwise all are of one place, and the error bar stays
    as wide. Tables of `calibgraph match` list them.
    """
    from calibgraph.cli.settings import read_settings
    from calibgraph.model.result_files import require_result_folder
    from calibgraph.tracking.command import track
    from calibgraph.tracking.state import require_poses_alone

    require_result_folder(out, [rig, Path(source)])
    with checked_arguments():
        settings, _ = read_settings(config, seed=seed)
        require_poses_alone(settings)
    guess = calibgraph.load_rig(rig)
    result, written = track(guess, source, config=settings, out=out, notify=print_line)
    _print_and_exit(result, written, as_json=False)
