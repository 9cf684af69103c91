"""The loop of a run: keep an engine busy, try again what may succeed, hand on the outcomes."""

import time
from collections import deque
from collections.abc import Iterable
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, replace

from calibgraph.errors import CalibrationError
from calibgraph.fleet.engines import Engine
from calibgraph.fleet.manifest import Job
from calibgraph.fleet.publisher import Publisher
from calibgraph.fleet.task import RETRIES, Limits, Outcome, Task, release
from calibgraph.progress import Progress

_AHEAD = 2
"""Tasks submitted per slot: one runs, one waits, so that no slot waits for this process."""
_WAIT_S = 1.0  # until rows are published that wait for others
LONGEST_WITHOUT_WORKERS_S = 120.0
"""A cluster that starts lost workers again needs seconds."""


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
