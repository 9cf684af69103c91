"""The commands that make a calibration: calibrate, match, solve."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from calibgraph.cli import options, outputs
from calibgraph.cli.arguments import checked_arguments
from calibgraph.cli.option_groups import MatchingOptions, SolveOptions
from calibgraph.cli.terminal import print_json, print_plain, progress_bar, terminal

if TYPE_CHECKING:
    from calibgraph.io.dataset import Dataset
    from calibgraph.model.calibration import Calibration
    from calibgraph.model.correspondences import Correspondences


def calibrate(
    dataset: list[Path],
    matching: MatchingOptions,
    out: Annotated[Path, outputs.RESULT] = Path("calibration"),
    *,
    solving: SolveOptions,
    as_json: options.JsonOption = False,
) -> None:
    """Calibrate all cameras jointly from images and clouds, with pictures and a report."""
    result, data, written = _calibrate(dataset, matching, out, solving)
    checks = next(iter(result.camera_verdicts.values())).checks
    copies = next((check.value for check in checks if check.name == "copies"), None)
    _print_frames_used(len(result.frames), data, int(copies or 0))
    _print_and_exit(result, written, as_json=as_json)


def _calibrate(
    dataset: list[Path], matching: MatchingOptions, out: Path, solving: SolveOptions
) -> tuple[Calibration, Dataset, list[Path]]:
    """The result, the data, and the files that were written."""
    from calibgraph.cli.compile_ahead import compile_ahead
    from calibgraph.memory import keep_freed_memory

    keep_freed_memory()
    from calibgraph.pipeline import calibrate
    from calibgraph.report.html import write_result

    with checked_arguments():
        settings, terms = solving.checked()
        chosen = matching.find_matcher(seed=settings.seed)
    data = matching.load_dataset(dataset)
    with compile_ahead(data.rig), progress_bar() as progress:
        result = calibrate(
            data,
            matcher=chosen,
            config=settings,
            terms=terms,
            time_limit_s=matching.limit_s,
            progress=progress,
        )
        result = _warned_of_same_data(result, matching.rig)
        return result, data, write_result(result, out, data)


def match(
    dataset: list[Path],
    matching: MatchingOptions,
    out: Annotated[Path, outputs.TABLE] = Path("correspondences.parquet"),
    seed: options.SeedOption = 0,
    as_json: options.JsonOption = False,
) -> None:
    """Find correspondences and write them as a table; exit 1 if a camera was not found.

    Args:
        out (FILE): Table to write, .parquet or .csv.
    """
    from calibgraph.model.result_files import MATCH, WRITTEN_KEY
    from calibgraph.rounds import match_in_rounds

    with checked_arguments():
        chosen = matching.find_matcher(seed=seed)
    data = matching.load_dataset(dataset)
    with progress_bar() as progress:
        run = match_in_rounds(
            data, matcher=chosen, time_limit_s=matching.limit_s, progress=progress
        )
        found = run.correspondences
        replace(found, metadata={**found.metadata, WRITTEN_KEY: MATCH}).save(out)
    _print_frames_used(len(run.dataset.frames), data, len(run.copies))
    _print_table_and_exit(run.correspondences, out, as_json=as_json)


def solve(
    rig: Path,
    correspondences: Path,
    out: Annotated[Path, outputs.RESULT] = Path("calibration"),
    *,
    solving: SolveOptions,
    camera_matches: Path | None = None,
    common_deg: Annotated[float | None, typer.Option(min=0)] = None,
    common_cm: Annotated[float | None, typer.Option(min=0)] = None,
    print_graph: Annotated[bool, typer.Option(callback=options.require_stdout)] = False,
    graph: Annotated[Path | None, outputs.GRAPH] = None,
    as_json: options.JsonOption = False,
) -> None:
    """Calibrate all cameras jointly from a table of correspondences, with a report.

    Args:
        rig (RIG): Rig with the initial guess.
        correspondences (CORRESPONDENCES): Table, .parquet or .csv, or a folder of .parquet files;
            larger than memory too.
        camera_matches (FILE): Features that cameras have in common: camera_matches.parquet of a
            result.
        common_deg (DEG): Error per axis that all frames share, 1 sigma; 0 if none. (default: as
            the table states)
        common_cm (CM): Likewise, of the position.
        print_graph: Print every factor of the graph whose optimum is the result, in place of
            tables.
        graph (FILE.dot): Write the graph in Graphviz's language to FILE.dot.
    """
    from calibgraph.files import sha256, write_text
    from calibgraph.graph.variables import to_dot
    from calibgraph.io.camera_match_tables import load_camera_matches
    from calibgraph.io.correspondence_tables import table_files
    from calibgraph.io.rigs import load_rig
    from calibgraph.pipeline import solve
    from calibgraph.report.html import write_result

    with checked_arguments():
        settings, terms = solving.checked(common_deg=common_deg, common_cm=common_cm)
        if print_graph and as_json:
            raise ValueError("--print-graph and --json both print; choose one")
    with progress_bar("solving"), checked_arguments():
        seen = None if camera_matches is None else load_camera_matches(camera_matches)
        result = solve(load_rig(rig), correspondences, settings, terms, camera_matches=seen)
        result = result.with_inputs({str(path): sha256(path)
                                     for path in table_files(correspondences)})  # fmt: skip
        result = _warned_of_same_data(result, rig)
        written = write_result(result, out)
        if graph is not None:
            write_text(graph, to_dot(result.graph))
    if print_graph:
        print(result.graph)
        raise typer.Exit(1 if result.verdict.status == "FAIL" else 0)
    _print_and_exit(result, written, as_json=as_json)


def _warned_of_same_data(result: Calibration, rig: Path | None) -> Calibration:
    """With a warning if what was estimated has a prior that is from the same data."""
    from calibgraph.io.calibrations import is_made_from
    from calibgraph.io.rigs import rig_file

    inputs = result.inputs.values()
    if rig is None or not result.config.estimate or not is_made_from(rig_file(rig), inputs):
        return result
    text = (
        f"{rig} was made from the same data, which count twice in the estimates of lens and clock: "
        "their sigmas are too small. Give the rig that you began with"
    )
    logging.getLogger(__name__).warning(text)
    return replace(result, warnings=(*result.warnings, text))


def _print_frames_used(used: int, data: Dataset, copies: int) -> None:
    """Print how many frames were matched, unless all were."""
    text = f"{used} of {len(data.frames)} frames"
    if used + copies < len(data.frames):
        text += ", spread over them, the clearest of neighbours; --frames takes others"
    if copies:
        text += f"; {copies} {'copies' if copies > 1 else 'copy'} left out"
    if used < len(data.frames):
        print_plain(terminal(), text)


def _print_table_and_exit(table: Correspondences, out: Path, *, as_json: bool) -> None:
    """Print the counts of a table of correspondences; exit 1 if a camera was not found."""
    missed = list(table.findings.missed)
    if as_json:
        print_json({"out": str(out), "matches": table.counts(), "missed": missed})
    else:
        counts = ", ".join(f"{name} {count}" for name, count in table.counts().items())
        print_plain(terminal(), f"{out}: {len(table)} correspondences ({counts})")
    if missed:
        names = ", ".join(missed)
        print_plain(
            terminal(), f"not found: {names}: a solve of their matches from the guess will FAIL"
        )
        raise typer.Exit(1)


def _print_and_exit(result: Calibration, written: list[Path], *, as_json: bool) -> None:
    """Print a result; exit 1 if it is FAIL."""
    if as_json:
        from calibgraph.report.as_json import result_summary

        print_json(result_summary(result, written))
    else:
        from calibgraph.cli.tables import print_result

        print_result(terminal(), result, written)
    if result.verdict.status == "FAIL":
        raise typer.Exit(1)
