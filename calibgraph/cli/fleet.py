"""The command for many vehicles: fleet."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING

import typer
from typer import Argument, Option

from calibgraph.cli.options import JsonOption
from calibgraph.cli.terminal import print_json, print_line, progress_bar

if TYPE_CHECKING:
    from calibgraph.fleet.page import FleetReport
    from calibgraph.fleet.run import Summary


def fleet(
    manifest: str = Argument(
        ...,
        metavar="MANIFEST",
        help="Table of the vehicles, .parquet or .csv, a path or URI. Columns: vehicle, "
        "recording (folders, or a table of correspondences), rig, settings.",
    ),
    out: str = Option(
        "fleet",
        metavar="URI",
        help="Folder or URI for the rows, fleet.html, fleet_model.json and estimates.parquet.",
    ),
    dask: str | None = Option(
        None,
        metavar="ADDRESS",
        help="Run the jobs on this Dask cluster, as tcp://host:8786. (default: on this machine)",
    ),
    jobs: int | None = Option(
        None, min=1, help="Jobs at once on this machine. (default: one per core)"
    ),
    timeout_s: float = Option(3600.0, min=0.001, metavar="SECONDS", help="Longest time of a job."),
    memory_gb: float | None = Option(
        None, min=0.1, metavar="GB", help="Most memory of a job. (default: no limit)"
    ),
    fetch_gb: float = Option(50.0, min=0.0, metavar="GB", help="Most bytes of a remote recording."),
    as_json: JsonOption = False,
) -> None:
    """Calibrate many vehicles, each alone, and show on one page which of them stand apart.

    What is finished is not done again: after Ctrl-C, a crash or a lost machine the same command
    goes on. Exit 1 if a job failed or a camera's verdict is FAIL.
    """
    from calibgraph.errors import CalibrationError
    from calibgraph.fleet.job import Limits
    from calibgraph.fleet.page import write_fleet_report
    from calibgraph.fleet.run import dask_executor, run_fleet, thread_executor

    if dask is not None and jobs is not None:
        raise CalibrationError("--jobs is of this machine: with --dask the cluster's threads count")
    memory_bytes = None if memory_gb is None else int(memory_gb * 1e9)
    limits = Limits(timeout_s=timeout_s, memory_bytes=memory_bytes, fetch_bytes=fetch_gb * 1e9)
    opened = thread_executor(jobs) if dask is None else dask_executor(dask)
    with _interrupt_on_sigterm(), progress_bar() as progress, opened as executor:
        summary = run_fleet(manifest, out, executor=executor, limits=limits, progress=progress)
    report = write_fleet_report(out)
    if as_json:
        print_json({"out": out, **asdict(summary), "findings": [f.text for f in report.findings]})
    else:
        _print(summary, report, out)
    if summary.failures or "FAIL" in summary.verdicts:
        raise typer.Exit(1)


@contextmanager
def _interrupt_on_sigterm() -> Iterator[None]:
    """End as on Ctrl-C when a scheduler stops this process: what is done is published."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _print(summary: Summary, report: FleetReport, out: str) -> None:
    of, apart = report.fleet.observations, report.fleet.apart
    counts = [f"{summary.verdicts.get(name, 0)} {name}" for name in ("PASS", "WARN", "FAIL")]
    lines = [f"{out}: {summary.jobs} jobs, {summary.skipped} finished before; cameras: "
             + ", ".join(counts)]  # fmt: skip
    lines += [f"failed: {count} ({kind}); see the column error, and _logs"
              for kind, count in summary.failures.items()]  # fmt: skip
    lines += [
        f"{len({*of.vehicle.tolist()})} vehicles, {int(of.measured.sum())} cameras measured; "
        f"{int(apart.sum())} cameras of {len({*of.vehicle[apart].tolist()})} vehicles stand apart"
    ]
    lines += [finding.text for finding in report.findings]
    lines += [f"{vehicle}: all cameras moved alike: the LiDAR was moved"
              for vehicle in report.moved_lidars]  # fmt: skip
    for line in [*lines, f"wrote {out}/fleet.html"]:
        print_line(line)
