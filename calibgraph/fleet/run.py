"""A manifest from its rows to the rows of its results: ``run_fleet``."""

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import pyarrow as pa

from calibgraph.child_process import Outcome
from calibgraph.errors import CalibrationError, FileError, needs_extra
from calibgraph.fleet.files import ROWS, SCHEMA, Store, read_rows
from calibgraph.fleet.job import RELEASE, Limits, end_children, interrupt_jobs, run_job
from calibgraph.fleet.manifest import Job, Key, load_manifest
from calibgraph.model.calibration import package_versions
from calibgraph.parallel import count_cores
from calibgraph.progress import Progress, no_progress

_READERS = 16  # threads that look at inputs: a listing of an object store takes 50 ms
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
    """Calibrate the vehicles of a manifest, each alone, and write a row per camera.

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
    (jobs, others), store = load_manifest(manifest), Store(out)
    with store.locked():
        rows, hashes = _known_rows(out, jobs), _hashes(jobs, report)
        todo = [job for job in jobs if not _is_finished(rows[job.key], hashes[job.key])]
        failed = 0
        with nullcontext(executor) if executor is not None else thread_executor() as opened:
            running = {opened.submit(run_job, job, limits, RELEASE): job for job in todo}
            for count, future in enumerate(as_completed([*running]), start=1):
                job, outcome = running.pop(future), _outcome_of(future)
                rows[job.key] = _rows_of(job, outcome, hashes[job.key])
                table = pa.Table.from_pylist(rows[job.key], schema=SCHEMA)
                further = others.take(pa.array([job.row] * len(table)))
                for column in further.schema:
                    table = table.append_column(column, further[column.name])
                _write(store, job, outcome, table)
                failed += outcome.error_kind is not None
                stage = f"calibrating ({failed} failed)" if failed else "calibrating"
                report(stage, count, len(todo))
    every = [row for job in jobs for row in rows[job.key]]
    verdicts = Counter(row["verdict"] for row in every if row["status"] == "done")
    failures = Counter(row["error_kind"] for row in every if row["status"] != "done")
    return Summary(len(jobs), len(jobs) - len(todo), dict(verdicts), dict(failures))


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


def _outcome_of(future: Future[Outcome]) -> Outcome:
    """The outcome of a task, or that its worker was lost."""
    try:
        return future.result()
    except CalibrationError as error:
        raise CalibrationError(str(error).splitlines()[-1]) from error
    except Exception as error:  # of the cluster
        lost = f"its machine was lost ({type(error).__name__})"
        return Outcome(error_kind="worker died", error=lost)


def _rows_of(job: Job, outcome: Outcome, input_hash: str) -> list[dict[str, Any]]:
    """A row per camera, or one of the failure."""
    common = dict.fromkeys(_STATE) | {
        "vehicle": job.vehicle, "recording": job.recording, "seconds": outcome.seconds,
        "input_hash": input_hash, "versions": json.dumps(package_versions()),
    }  # fmt: skip
    if outcome.error_kind is None:
        return [{**common, "status": "done", **cells} for cells in outcome.result]
    error = {"error_kind": outcome.error_kind, "error": outcome.error}
    return [{**common, "camera": "", "status": "failed", **error}]


def _write(store: Store, job: Job, outcome: Outcome, rows: pa.Table) -> None:
    """Write the log of a job, then its rows."""
    number = hashlib.sha256("\n".join(job.key).encode()).hexdigest()[:16]
    name = f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', job.vehicle)[:100].lstrip('.')}-{number}"
    text = f"{job.vehicle}: {job.recording}\n{outcome.log}{outcome.seconds:8.1f} s  "
    store.put(f"_logs/{name}.log", f"{text}{outcome.error or 'done'}\n".encode())
    store.put(f"{ROWS}/{name}.parquet", rows)


def _known_rows(out: str, jobs: Sequence[Job]) -> dict[Key, list[dict[str, Any]]]:
    """The states of jobs that an earlier run wrote."""
    found, own = defaultdict[Key, list[dict[str, Any]]](list), {job.key for job in jobs}
    for row in read_rows(out, may_be_new=True).select(_STATE).to_pylist():
        if (key := (row["vehicle"], row["recording"])) in own:
            found[key].append(row)
            version = json.loads(row["versions"]).get("calibgraph")
            if version != RELEASE:
                raise FileError(
                    out, f"holds rows of calibgraph {version}, this is {RELEASE}; choose another "
                    "--out"
                )  # fmt: skip
    return found


def _is_finished(rows: Sequence[dict[str, Any]], input_hash: str) -> bool:
    """Whether a job need not be done again."""
    return bool(input_hash and rows) and all(
        row["input_hash"] == input_hash
        and (row["status"] == "done" or row["error_kind"] == "bad input")
        for row in rows
    )


def _hashes(jobs: Sequence[Job], report: Progress) -> dict[Key, str]:
    """Of the inputs of all jobs; empty where they cannot be read: the job will fail by it."""
    found = dict[Key, str]()
    with ThreadPoolExecutor(_READERS) as pool:
        for job, future in [(job, pool.submit(job.input_hash)) for job in jobs]:
            report("reading inputs", len(found), len(jobs))
            failed = future.exception() is not None  # of any store's client
            found[job.key] = "" if failed else future.result()
    return found
