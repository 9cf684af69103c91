"""The commands that serve pages, serve and pick; and fleet, for many vehicles."""

from __future__ import annotations

import signal
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import typer
from typer import Argument, Option

import calibgraph
from calibgraph.cli import options
from calibgraph.cli.options import JsonOption, bag_settings, dataset_from
from calibgraph.cli.terminal import print_line, progress_bar
from calibgraph.errors import CalibrationError, FileError, needs_extra
from calibgraph.stdout import print_json

if TYPE_CHECKING:
    from calibgraph.fleet.page import FleetReport
    from calibgraph.fleet.run import Summary


_GB = 10**9


def serve(
    data: Path = Option(
        Path("calibgraph-service"), metavar="DIR", help="Folder for jobs, results and trackers."
    ),
    host: str = Option("127.0.0.1", help="Address to listen on."),
    port: int = Option(8080, min=0, max=65535, help="Port to listen on."),
    tokens: Path | None = Option(
        None, metavar="FILE", help="Who may call. (default: anyone on this machine)"
    ),
    new_token: bool = Option(
        False, "--new-token", help="Add a token to the file of --tokens, print it, and end."
    ),
    host_name: list[str] | None = Option(
        None, metavar="NAME", help="Name the server is called by; may be repeated."
    ),
    jobs: int | None = Option(None, min=0, help="Jobs at once. (default: one per core)"),
    timeout_s: float = Option(3600.0, min=0.001, metavar="SECONDS", help="Longest time of a job."),
    memory_gb: float = Option(
        8.0, min=0.1, metavar="GB", help="Most memory of a job, and of a process with trackers."
    ),
    recording_gb: float = Option(
        20.0, min=0.001, metavar="GB", help="Largest upload, unpacked too."
    ),
    free_gb: float = Option(1.0, min=0.0, metavar="GB", help="With less on the disk, refuse jobs."),
    keep_days: float = Option(30.0, min=0.001, metavar="DAYS", help="How long results are kept."),
    tracker_processes: int = Option(2, min=1, help="Processes that hold the trackers."),
) -> None:
    """Calibrate, check and track for others, over HTTP, until stopped.

    Ctrl-C and SIGTERM lose nothing: jobs that run wait for the next start, as after a crash.
    """
    with needs_extra("service", "the server needs fastapi, hypercorn and others"):
        for package in ("fastapi", "hypercorn", "python_multipart"):
            import_module(package)
    from calibgraph.service.app import create_app, require_safe
    from calibgraph.service.app import serve as serve_app
    from calibgraph.service.requests import Settings

    if new_token:
        _add_token(tokens)
        return
    require_safe(host, has_tokens=tokens is not None)
    counted = {} if jobs is None else {"jobs_at_once": jobs}
    settings = Settings(
        data=data,
        tokens=tokens,
        hosts=tuple(host_name or ()),
        job_timeout_s=timeout_s,
        memory_bytes=int(memory_gb * _GB),
        recording_bytes=int(recording_gb * _GB),
        free_bytes=int(free_gb * _GB),
        keep_s=keep_days * 86400,
        tracker_processes=tracker_processes,
        **counted,
    )
    serve_app(create_app(settings), host, port, lambda url: _announce(url, tokens))


def _announce(url: str, tokens: Path | None) -> None:
    """Where the page is, and whether it asks for a token."""
    needed = "no token is needed, and no other machine can reach it"
    if tokens is not None:
        needed = (
            f"it asks for a token of {tokens} as the password; one is made by "
            f"calibgraph serve --tokens {quote(str(tokens))} --new-token"
        )
    print_line(f"open {url} in a browser: {needed}")


def _add_token(path: Path | None) -> None:
    """Make a token and print it: the file keeps its hash only."""
    from calibgraph.service.request_guard import add_token

    if path is None:
        raise CalibrationError("--new-token: give --tokens FILE, the file that it is added to")
    print(add_token(path))
    print_line(f"{path}: a token was added")


def pick(
    dataset: options.Datasets,
    out: Path = Option(
        ...,
        metavar="DIR",
        help="Folder of the session, which is continued if it is there, and of what it gives: "
        "reference.yaml and picked.parquet.",
    ),
    rig: options.RigFile = None,
    frames: options.Frames = None,
    topic: options.Topic = None,
    motion: options.Motion = None,
    config: options.ReadingFile = None,
    port: int = Option(0, min=0, max=65535, help="Of this machine. (default: any that is free)"),
    show: bool = Option(True, "--show/--no-show", help="Open the page in the browser."),
) -> None:
    """Pick a reference by hand: a page on which pixels and LiDAR points are paired.

    The server answers this machine only. Ends with Ctrl-C; every change is saved at once.
    """
    from calibgraph.files import require_own_folder
    from calibgraph.io.rigs import REFERENCE_FILE
    from calibgraph.pick.estimate import SESSION_FILE
    from calibgraph.pick.server import TABLE_FILE, PickServer, Workspace

    require_own_folder(out, dataset)
    for path in (out / REFERENCE_FILE, out / TABLE_FILE):
        if path.exists() and not (out / SESSION_FILE).exists():
            raise FileError(path, "is of no session of pick, and would be replaced; move it")
    bag = bag_settings(config, topic, motion=motion)
    workspace = Workspace(dataset_from(dataset, rig, frames, bag), out)
    try:
        server = PickServer(workspace, port)
    except OSError as error:
        raise CalibrationError(
            f"--port {port}: cannot be used ({error.strerror}); leave it out for a free one"
        ) from error
    with server:
        print_line(f"{server.url}: pick there; end with Ctrl-C")
        if show:
            webbrowser.open(server.url)
        server.serve_forever()


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
    from calibgraph.fleet.job import Limits
    from calibgraph.fleet.run import dask_executor, thread_executor

    if dask is not None and jobs is not None:
        raise CalibrationError("--jobs is of this machine: with --dask the cluster's threads count")
    memory_bytes = None if memory_gb is None else int(memory_gb * 1e9)
    limits = Limits(timeout_s=timeout_s, memory_bytes=memory_bytes, fetch_bytes=fetch_gb * 1e9)
    opened = thread_executor(jobs) if dask is None else dask_executor(dask)
    with _interrupt_on_sigterm(), progress_bar() as progress, opened as executor:
        summary = calibgraph.run_fleet(
            manifest, out, executor=executor, limits=limits, progress=progress
        )
    report = calibgraph.write_fleet_report(out)
    if as_json:
        print_json({"out": out, **asdict(summary), "moved_lidars": [*report.moved_lidars]})
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
    lines += [f"{vehicle}: all cameras moved alike: the LiDAR was moved"
              for vehicle in report.moved_lidars]  # fmt: skip
    print_line(*lines, f"wrote {out}/fleet.html")
