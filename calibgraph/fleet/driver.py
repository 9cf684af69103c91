"""The loop of a run: keep an engine busy, try again what may succeed, publish rows and logs."""

import hashlib
import re
import time
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace
from typing import Any

import pyarrow as pa

from calibgraph.errors import CalibrationError
from calibgraph.fleet.engines import Engine
from calibgraph.fleet.execute import versions_text
from calibgraph.fleet.manifest import Job
from calibgraph.fleet.rows import SCHEMA, RowStore
from calibgraph.fleet.task import RETRIES, Limits, Outcome, Task, release
from calibgraph.progress import Progress

_AHEAD = 2
"""Tasks submitted per slot: one runs, one waits, so that no slot waits for this process."""
_WAIT_S = 1.0  # until rows are published that wait for others
LONGEST_WITHOUT_WORKERS_S = 120.0
"""A cluster that starts lost workers again needs seconds."""


_PUBLISH_EVERY_S = 5.0
"""Rows wait this long for others of their bucket; so much work a command that is killed may lose.
"""


class Publisher:
    """Publishes outcomes, some at a time."""

    def __init__(self, store: RowStore, others: pa.Table, *, logs: bool) -> None:
        self._store, self._others, self._logs = store, others, logs
        self._rows: list[dict[str, Any]] = []
        self._manifest_rows: list[int] = []
        self._published_s = time.monotonic()
        self.failed = 0

    def add(self, job: Job, input_hash: str, outcome: Outcome) -> None:
        """Take an outcome; its log is kept at once."""
        self.failed += outcome.error_kind is not None
        for row in _rows_of(job, input_hash, outcome):
            self._rows.append(row)
            self._manifest_rows.append(job.row)
        if self._logs:
            self._store.put(f"_logs/{_log_name(job)}", _log_text(job, outcome).encode())

    def publish_when_due(self) -> None:
        """Publish what has waited long enough."""
        if time.monotonic() - self._published_s > _PUBLISH_EVERY_S:
            self.publish()

    def publish(self) -> None:
        """Publish all."""
        if self._rows:
            table = pa.Table.from_pylist(self._rows, schema=SCHEMA)
            others = self._others.take(pa.array(self._manifest_rows))
            for name in others.column_names:
                table = table.append_column(others.schema.field(name), others[name])
            self._store.publish(table)
        self._rows, self._manifest_rows = [], []
        self._published_s = time.monotonic()


def _rows_of(job: Job, input_hash: str, outcome: Outcome) -> Iterator[dict[str, Any]]:
    common = {
        "vehicle": job.vehicle,
        "recording": job.recording,
        "seconds": outcome.seconds,
        "input_hash": input_hash,
        "versions": outcome.versions or versions_text(),
    }
    if outcome.error_kind is not None:
        failure = {"error_kind": outcome.error_kind, "error": outcome.error}
        yield {**common, "camera": "", "status": "failed", **failure}
    for camera in outcome.cameras:
        yield {**common, "status": "done", **vars(camera)}


def _log_name(job: Job) -> str:
    """A name of a file: vehicles may be called anything."""
    number = hashlib.sha256("\n".join(job.key).encode()).hexdigest()[:8]
    return f"{re.sub(r'[^A-Za-z0-9_.-]+', '_', job.vehicle)[:100]}-{number}.log"


def _log_text(job: Job, outcome: Outcome) -> str:
    end = "done" if outcome.error_kind is None else f"{outcome.error_kind}: {outcome.error}"
    end = str(CalibrationError(end))  # in one line
    return f"{job.vehicle}: {job.recording}\n{outcome.log}{outcome.seconds:8.1f} s  {end}\n"


@dataclass(frozen=True)
class Try:
    """A job to be tried, unless its outcome is known without a try; tries count from 0."""

    job: Job
    input_hash: str
    known: Outcome | None = None
    number: int = 0
    log: str = ""


class Driver:
    """Runs jobs on an engine and publishes their outcomes."""

    def __init__(self, engine: Engine, publisher: Publisher, limits: Limits) -> None:
        self._engine, self._publisher, self._limits = engine, publisher, limits
        self._waiting: deque[Try] = deque()
        self._running: dict[Future[Outcome], Try] = {}
        self._retries = 0
        self._last_worker_s = time.monotonic()

    def run(self, tries: Iterable[Try], report: Progress) -> int:
        """Run all, and publish what is done even if this is interrupted; count the retries.

        Raises:
            CalibrationError: if workers have another version of this package, or there are none.
        """
        self._waiting.extend(tries)
        total = len(self._waiting)
        try:
            while self._waiting or self._running:
                self._submit()
                ended, _ = wait(self._running, _WAIT_S, FIRST_COMPLETED)
                self._require_workers()
                for future in ended:
                    self._take(self._running.pop(future), _outcome_of(future))
                self._publisher.publish_when_due()
                left = len(self._waiting) + len(self._running)
                failed = self._publisher.failed
                report(f"calibrating ({failed} failed)" if failed else "calibrating",
                       total - left, total)  # fmt: skip
        finally:
            self._publisher.publish()
        return self._retries

    def _require_workers(self) -> None:
        now = time.monotonic()
        if self._engine.has_workers():
            self._last_worker_s = now
        elif now - self._last_worker_s > LONGEST_WITHOUT_WORKERS_S:
            raise CalibrationError(
                f"the cluster has had no worker for {LONGEST_WITHOUT_WORKERS_S:.0f} s, or none "
                "with the memory of --memory-gb; finished rows are published: start workers and "
                "give the same command again"
            )

    def _submit(self) -> None:
        """Fill the engine, not more: a manifest may have millions of rows."""
        while self._waiting and len(self._running) < _AHEAD * self._engine.slots:
            each = self._waiting.popleft()
            if each.known is not None:
                self._take(each, each.known)
                continue
            task = Task(each.job, self._limits, release())
            self._running[self._engine.submit(task)] = each

    def _take(self, each: Try, outcome: Outcome) -> None:
        """Publish an outcome, or try again."""
        log = each.log + outcome.log
        if outcome.error_kind is None or each.number >= RETRIES[outcome.error_kind] or each.known:
            self._publisher.add(each.job, each.input_hash, replace(outcome, log=log))
            return
        self._retries += 1
        log += f"try {each.number + 1} failed: {outcome.error_kind}: {outcome.error}\n"
        self._waiting.append(replace(each, number=each.number + 1, log=log))


def _outcome_of(future: Future[Outcome]) -> Outcome:
    """The outcome of a task, or that its worker was lost."""
    error = future.exception()
    if error is None:
        return future.result()
    if isinstance(error, CalibrationError):
        raise CalibrationError(str(error).splitlines()[-1]) from error
    return Outcome(error_kind="worker died", error=f"its machine was lost ({type(error).__name__})")
