"""One job in one process: fetch, calibrate or solve, and return the cells of its rows.

``run_job`` is the task of an executor: of threads here, or of Dask on other machines. Each thread
keeps a child process, because loading the libraries takes longer than a small solve.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from calibgraph.child_process import (
    ChildEndedError,
    ChildProcess,
    Outcome,
    answer_requests,
    failed,
    memory_limit,
    output_to,
)
from calibgraph.errors import CalibrationError
from calibgraph.fleet.files import fetch
from calibgraph.fleet.manifest import Job
from calibgraph.model.calibration import version_of
from calibgraph.report.as_json import verdict_summary

RELEASE = version_of("calibgraph")
_LOG, _MOST_LOG = "log.txt", 2**16
_kept = threading.local()
_children: list[ChildProcess] = []


@dataclass(frozen=True)
class Limits:
    """Limits of one job.

    Attributes:
        timeout_s: wall time, with fetching.
        memory_bytes: that the job may allocate; None: no limit.
        fetch_bytes: of remote recordings that are copied to the worker's disk.
    """

    timeout_s: float = 3600.0
    memory_bytes: int | None = None
    fetch_bytes: float = 50e9


def run_job(job: Job, limits: Limits, of_release: str) -> Outcome:
    """Run a job in the child process of this thread.

    Raises:
        CalibrationError: if this machine has another version of the package than the command.
    """
    if of_release != RELEASE:
        raise CalibrationError(
            f"a worker has calibgraph {RELEASE}, the command {of_release}; install the same "
            "version on all machines"
        )
    if getattr(_kept, "child", None) not in _children:
        _kept.child = ChildProcess(__name__)
        _children.append(_kept.child)
    with TemporaryDirectory(prefix="calibgraph-fleet-") as folder:
        start = time.perf_counter()
        try:
            _kept.child.start()
            start = time.perf_counter()  # the libraries' loading is not the job's time
            outcome: Outcome = _kept.child.ask((job, limits, Path(folder)), limits.timeout_s)
        except ChildEndedError as error:
            advice = "; see --timeout-s" if error.kind == "timeout" else ""
            outcome = Outcome(error_kind=error.kind, error=f"{error}{advice}")
        seconds, log = time.perf_counter() - start, Path(folder) / _LOG
        text = log.read_bytes()[-_MOST_LOG:].decode(errors="replace") if log.exists() else ""
    return replace(outcome, seconds=seconds, log=text)


def interrupt_jobs() -> None:
    """End all jobs of this process's threads, which then start no other."""
    for child in _children:
        child.interrupt()


def end_children() -> None:
    """End the processes of threads that have ended."""
    while _children:
        _children.pop().close()


def main() -> None:
    """The child's side."""
    import calibgraph.pipeline  # noqa: F401 - it takes seconds, which are not the first job's

    fetched: list[Path] = []

    def answer(request: tuple[Job, Limits, Path], _: object) -> Outcome:
        job, limits, folder = request
        fetched[:] = [folder]
        with output_to(folder / _LOG), memory_limit(limits.memory_bytes):
            return execute(job, limits, folder)

    def remove_fetched() -> None:
        for folder in fetched:
            shutil.rmtree(folder, ignore_errors=True)

    answer_requests(answer, remove_fetched)


def execute(job: Job, limits: Limits, folder: Path) -> Outcome:
    """Run a job here; what is wrong with its data or its machine is part of the outcome."""
    places = dict[str, str]()

    def local(uri: str) -> Path:
        """Noted for messages."""
        path = fetch(uri, folder / str(len(places)), limits.fetch_bytes)
        places[str(path)] = uri
        return path

    try:
        return Outcome(_calibrate(job, limits, local))
    except Exception as error:
        return failed(error, places)


def _calibrate(
    job: Job, limits: Limits, local: Callable[[str], Path]
) -> tuple[dict[str, Any], ...]:
    """The cells of each camera's row."""
    from calibgraph.io.dataset import load_dataset
    from calibgraph.io.rigs import load_rig
    from calibgraph.matching.named import structure_matcher
    from calibgraph.pipeline import calibrate, solve

    settings = job.settings
    rig = load_rig(local(job.rig)) if job.rig else None
    paths = [local(uri) for uri in job.recordings]
    if job.is_table and rig is not None:
        return _cells(solve(rig, paths[0], settings.config))
    result = calibrate(
        load_dataset(paths, rig, frames=settings.frames),
        matcher=structure_matcher(
            seed=settings.config.seed,
            all_frames=settings.frames is not None,
            search_deg=settings.search_deg,
            search_m=settings.search_m,
        ),
        config=settings.config,
        time_limit_s=limits.timeout_s / 2,  # the rest is for the checks
    )
    return _cells(result)


def _cells(result: Any) -> tuple[dict[str, Any], ...]:
    rows = []
    for camera, verdict in result.camera_verdicts.items():
        covariance, summary = result.covariance[camera], result.summary_of(camera)
        rows.append({
            "camera": camera, **verdict_summary(verdict),
            "reasons": [reason.text for reason in summary.reasons],
            "actions": [*summary.actions], "of": result.config.of,
            "T_camera_lidar": result.T_camera_lidar[camera].ravel().tolist(),
            "covariance": None if covariance is None else covariance.ravel().tolist(),
        })  # fmt: skip
    return tuple(rows)


if __name__ == "__main__":
    main()
