"""A manifest from its rows to the rows of its results: ``run_fleet``."""

import hashlib
import json
import re
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import pyarrow as pa

from calibgraph.errors import CalibrationError, FileError, needs_extra
from calibgraph.fleet.job import end_children, interrupt_jobs, run_job
from calibgraph.fleet.manifest import Job, load_manifest
from calibgraph.fleet.rows import SCHEMA, RowStore, bucket_of, job_keys
from calibgraph.fleet.task import Limits, Outcome, Task, release, versions_text
from calibgraph.parallel import count_cores
from calibgraph.progress import Progress, no_progress

_READERS = 16  # threads that look at inputs: a listing of an object store takes 50 ms
_AHEAD = 2000
"""Tasks submitted at a time: a manifest may have millions of rows, a cluster hundreds of cores."""
_PUBLISH_EVERY_S = 5.0
"""Rows wait this long for others of their bucket; so much work a command that is killed may lose.
"""
_WAIT_S = 1.0
_STATE = ["vehicle", "recording", "status", "verdict", "error_kind", "input_hash", "versions"]


@dataclass(frozen=True)
class Summary:
    """What is known of a manifest's jobs after a run.

    Attributes:
        jobs: of the manifest.
        skipped: of them those that were finished before.
        verdicts: per verdict, the cameras, those of skipped jobs too.
        failures: per kind of failure, the jobs.
    """

    jobs: int
    skipped: int
    verdicts: dict[str, int] = field(default_factory=dict)
    failures: dict[str, int] = field(default_factory=dict)


def run_fleet(
    manifest: str,
    out: str,
    *,
    executor: Executor | None = None,
    limits: Limits | None = None,
    progress: Progress | None = None,
) -> Summary:
    """Calibrate the vehicles of a manifest, each alone, and publish a row per camera.

    What an earlier run finished with the same inputs is not done again. A failed job is a row.

    Args:
        manifest: path or URI of a table, see ``fleet.manifest.load_manifest``.
        out: folder or URI of the rows.
        executor: runs the jobs, such as :func:`dask_executor`; if None, a thread per core.
        limits: of each job.
        progress: called as the work goes on.

    Raises:
        CalibrationError: if the manifest is wrong, rows or workers are of another version, or
            another command writes there.
    """
    report, limits = progress or no_progress, limits or Limits()
    found, store = load_manifest(manifest), RowStore(out)
    with store.locked():
        before, hashes = _rows_of(store, found.jobs), _hashes(found.jobs, report)
        done = _finished(store, before)
        todo = [job for job in found.jobs if (*job.key, hashes[job.key]) not in done]
        publisher = _Publisher(store, found.others, hashes)
        tasks = [Task(job, limits, release()) for job in todo]
        with nullcontext(executor) if executor is not None else thread_executor() as opened:
            _run(opened, tasks, publisher, report)
        after = _rows_of(store, found.jobs)
    verdicts = Counter(row["verdict"] for row in after if row["status"] == "done")
    failures = Counter(row["error_kind"] for row in after if row["status"] != "done")
    return Summary(len(found.jobs), len(found.jobs) - len(todo), dict(verdicts), dict(failures))


@contextmanager
def thread_executor(jobs: int | None = None) -> Iterator[Executor]:
    """Threads of this machine, one per core if None; jobs that run at the end are ended."""
    threads = ThreadPoolExecutor(jobs or count_cores())
    try:
        yield threads
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        interrupt_jobs()
        threads.shutdown()
        end_children()


@contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler, such as ``tcp://host:8786``.

    Raises:
        CalibrationError: if `distributed` is missing, or no scheduler with a worker is there.
    """
    with needs_extra("fleet", "--dask needs distributed"):
        distributed: Any = import_module("distributed")
    try:
        client = distributed.Client(address, timeout="30s")
        client.wait_for_workers(1, timeout=30)
    except Exception as error:  # of its communication
        raise CalibrationError(f"--dask {address}: no scheduler with workers ({error})") from error
    with client:
        executor: Executor = client.get_executor(pure=False, retries=0)
        try:
            yield executor
        finally:
            executor.shutdown(wait=False)  # cancels what has not ended


def _run(
    executor: Executor, tasks: Sequence[Task], publisher: "_Publisher", report: Progress
) -> None:
    """Run all, and publish what is done even if this is interrupted."""
    waiting, running = iter(tasks), dict[Future[Outcome], Task]()
    try:
        while True:
            while len(running) < _AHEAD and (task := next(waiting, None)) is not None:
                running[executor.submit(run_job, task)] = task
            if not running:
                return
            for future in wait(running, _WAIT_S, FIRST_COMPLETED).done:
                publisher.add(running.pop(future).job, _outcome_of(future))
            publisher.publish(_PUBLISH_EVERY_S)
            report(publisher.stage, publisher.count, len(tasks))
    finally:
        publisher.publish()


def _outcome_of(future: Future[Outcome]) -> Outcome:
    """The outcome of a task, or that its worker was lost."""
    try:
        return future.result()
    except CalibrationError as error:
        raise CalibrationError(str(error).splitlines()[-1]) from error
    except Exception as error:  # of the cluster
        lost = f"its machine was lost ({type(error).__name__})"
        return Outcome(error_kind="worker died", error=lost)


class _Publisher:
    """Publishes outcomes, some at a time."""

    def __init__(self, store: RowStore, others: pa.Table, hashes: dict[tuple[str, str], str]):
        self._store, self._others, self._hashes = store, others, hashes
        self._rows: list[dict[str, Any]] = []
        self._manifest_rows: list[int] = []
        self._published_s = time.monotonic()
        self.count = self._failed = 0

    @property
    def stage(self) -> str:
        """What goes on, in words."""
        return f"calibrating ({self._failed} failed)" if self._failed else "calibrating"

    def add(self, job: Job, outcome: Outcome) -> None:
        """Take an outcome; its log is kept at once."""
        common = {"vehicle": job.vehicle, "recording": job.recording, "seconds": outcome.seconds,
                  "input_hash": self._hashes[job.key], "versions": versions_text()}  # fmt: skip
        rows, end = [{**common, "status": "done", **cells} for cells in outcome.cameras], "done"
        if outcome.error_kind is not None:
            error = {"error_kind": outcome.error_kind, "error": outcome.error}
            rows, end = [{**common, "camera": "", "status": "failed", **error}], str(outcome.error)
        self._rows += rows
        self._manifest_rows += [job.row] * len(rows)
        self.count, self._failed = self.count + 1, self._failed + (outcome.error_kind is not None)
        text = f"{job.vehicle}: {job.recording}\n{outcome.log}{outcome.seconds:8.1f} s  {end}\n"
        self._store.put(f"_logs/{_log_name(job)}", text.encode())

    def publish(self, every_s: float = 0.0) -> None:
        """Publish all, if the last time is so long ago."""
        if not self._rows or time.monotonic() - self._published_s < every_s:
            return
        table = pa.Table.from_pylist(self._rows, schema=SCHEMA)
        others = self._others.take(pa.array(self._manifest_rows))
        for name in others.column_names:
            table = table.append_column(others.schema.field(name), others[name])
        self._store.publish(table)
        self._rows, self._manifest_rows = [], []
        self._published_s = time.monotonic()


def _log_name(job: Job) -> str:
    """A name of a file: vehicles may be called anything."""
    number = hashlib.sha256("\n".join(job.key).encode()).hexdigest()[:8]
    return f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', job.vehicle)[:100]}-{number}.log"


def _rows_of(store: RowStore, jobs: Sequence[Job]) -> list[dict[str, Any]]:
    """The states of these jobs as they are published."""
    own, found = {job.key for job in jobs}, []
    for bucket in sorted({bucket_of(job.vehicle) for job in jobs}):
        rows = store.read(bucket)
        mine = pa.array([key in own for key in job_keys(rows)], pa.bool_())
        found += rows.filter(mine).select(_STATE).to_pylist()
    return found


def _finished(store: RowStore, rows: list[dict[str, Any]]) -> set[tuple[str, str, str]]:
    """The keys and input hashes of what need not be done again."""
    for version in {json.loads(row["versions"]).get("calibgraph") for row in rows} - {release()}:
        raise FileError(
            store.uri, f"holds rows of calibgraph {version}, this is {release()}; choose another "
            "--out"
        )  # fmt: skip
    return {
        (row["vehicle"], row["recording"], row["input_hash"])
        for row in rows
        if row["input_hash"] and (row["status"] == "done" or row["error_kind"] == "bad input")
    }


def _hashes(jobs: Sequence[Job], report: Progress) -> dict[tuple[str, str], str]:
    """Of the inputs of all jobs; empty where they cannot be read: the job will fail by it."""
    found = dict[tuple[str, str], str]()
    with ThreadPoolExecutor(_READERS) as pool:
        for job, text in zip(jobs, pool.map(_hash_of, jobs), strict=True):
            report("reading inputs", len(found), len(jobs))
            found[job.key] = text
    return found


def _hash_of(job: Job) -> str:
    try:
        return job.input_hash()
    except Exception:  # of any store's client
        return ""
