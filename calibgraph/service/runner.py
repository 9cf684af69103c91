"""Runs the jobs of the table, each in a child process, and keeps the table in order."""

import logging
import shutil
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

from sqlalchemy.exc import SQLAlchemyError

from calibgraph.child_process import ChildEndedError, ChildProcess, ChildTimeoutError
from calibgraph.service.folders import DataFolder, remove_folder
from calibgraph.service.jobs import FINISHED, MOST_STARTS, JobRecord, JobTable
from calibgraph.service.metrics import Metrics
from calibgraph.service.places import Root
from calibgraph.service.requests import INPUT, RESULT, WORK, JobOutcome, JobProgress, JobTask
from calibgraph.service.settings import Settings

log = logging.getLogger("calibgraph.service")

_CHILD = "calibgraph.service.job_process"
_JOBS_PER_CHILD = 200
"""Then a new process takes its place: leaks of libraries do not add up."""
_LOOK_EVERY_S = 1.0
_EXPIRE_EVERY_S = 60.0
_RETRY_AFTER_S = 2.0  # when the table cannot be used


@dataclass
class _Slot:
    """A thread's child process, and the job in it."""

    child: ChildProcess = field(default_factory=lambda: ChildProcess(_CHILD))
    job: str | None = None
    jobs: int = 0


class Runner:
    """The threads that run jobs."""

    def __init__(
        self,
        table: JobTable,
        folder: DataFolder,
        settings: Settings,
        roots: tuple[Root, ...],
        *,
        metrics: Metrics,
    ) -> None:
        self._table, self._folder, self._settings = table, folder, settings
        self._roots, self._metrics = roots, metrics
        self._steps: dict[str, JobProgress] = {}
        self._deaths: Counter[str] = Counter()
        self._slots = [_Slot() for _ in range(settings.jobs_at_once)]
        self._threads: list[threading.Thread] = []
        self._taking, self._added = threading.Lock(), threading.Event()
        self._is_stopping = threading.Event()

    def start(self) -> None:
        """Put back what an earlier server left running, and begin."""
        again = self._table.put_back()
        if again:
            log.info("%d jobs that an earlier server had begun are run again", again)
        self._remove_leftovers()
        targets = [lambda slot=slot: self._work(slot) for slot in self._slots]
        for target in (*targets, self._expire):
            thread = threading.Thread(target=target, daemon=True)
            thread.start()
            self._threads.append(thread)

    def wake(self) -> None:
        """Look for jobs: one was added."""
        self._added.set()

    def step(self, id: str) -> JobProgress | None:
        """How far a running job is."""
        return self._steps.get(id)

    def is_alive(self) -> bool:
        """Whether all threads run."""
        return all(thread.is_alive() for thread in self._threads)

    def cancel(self, id: str) -> bool:
        """Cancel a job; False if it is finished."""
        if not self._table.cancel(id):
            return False
        with self._taking:
            running = [slot for slot in self._slots if slot.job == id]
            for slot in running:
                slot.child.kill()
        if not running:
            self._discard_input(id)
        return True

    def begin_stop(self) -> None:
        """Start no more jobs."""
        self._is_stopping.set()
        self._added.set()

    def stop(self, grace_s: float) -> None:
        """Give running jobs some time to end, then let them wait for the next server."""
        self.begin_stop()
        end = time.monotonic() + grace_s
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))
        for slot in self._slots:
            slot.child.interrupt()
        for thread in self._threads:
            thread.join()
        for slot in self._slots:
            slot.child.close()

    def _work(self, slot: _Slot) -> None:
        """A thread: one job after the other."""
        while not self._is_stopping.is_set():
            try:
                with suppress(ChildEndedError):  # no job dies while libraries load
                    slot.child.start()
                self._added.clear()
                record = self._take(slot)
                if record is None:
                    self._added.wait(_LOOK_EVERY_S)
                else:
                    self._run(slot, record)
            except Exception:  # of the database, of the disk
                log.exception("the table of jobs or the data folder cannot be used")
                self._recover(slot)

    def _recover(self, slot: _Slot) -> None:
        """After an error: let the slot's job wait again, as soon as the table can be used."""
        slot.child.stop()
        while slot.job is not None:
            time.sleep(_RETRY_AFTER_S)
            with suppress(SQLAlchemyError), self._taking:
                self._table.put_back(slot.job)
                slot.job = None
            if self._is_stopping.is_set():
                break

    def _take(self, slot: _Slot) -> JobRecord | None:
        with self._taking:
            slot.job = None
            record = self._table.start_next(self._settings.jobs_per_tenant)
            slot.job = None if record is None else record.id
        return record

    def _run(self, slot: _Slot, record: JobRecord) -> None:
        """Run a job and write down how it ended."""
        start = time.perf_counter()
        outcome = self._ask(slot, record)
        if outcome is None:  # the server stops, or the process died: it waits again
            self._table.put_back(record.id)
        elif outcome.error_kind is None and outcome.verdict is not None:
            self._keep_result(record.id)
            self._table.finish(record.id, "succeeded", verdict=outcome.verdict,
                               cannot_tell=outcome.cannot_tell)  # fmt: skip
        else:
            self._table.finish(
                record.id, "failed", error_kind=outcome.error_kind, error=outcome.error
            )
        if outcome is not None:
            self._deaths.pop(record.id, None)
        if outcome is not None or self._is_finished(record.id):
            self._discard_input(record.id)
        with self._taking:
            slot.job = None
        self._steps.pop(record.id, None)
        state = "put back" if outcome is None else "failed" if outcome.error_kind else "succeeded"
        self._metrics.jobs.labels(record.kind, state).inc()
        self._metrics.job_s.labels(record.kind).observe(time.perf_counter() - start)

    def _ask(self, slot: _Slot, record: JobRecord) -> JobOutcome | None:
        """What the child answers; None if the job is to wait again."""
        limit_s = self._settings.job_timeout_s
        try:
            slot.child.start()
            current = self._table.get(record.id)
            if current is None or current.state != "running":  # cancelled meanwhile
                return JobOutcome(error_kind="bad input", error="cancelled")
            outcome: JobOutcome = slot.child.ask(
                self.task(record.id), limit_s, partial(self._steps.__setitem__, record.id)
            )
            self._renew(slot, failed=outcome.error_kind is not None)
            return outcome
        except ChildTimeoutError as error:
            return JobOutcome(error_kind="timeout", error=f"{error}; give fewer frames")
        except ChildEndedError as error:
            slot.child.stop()
            if self._is_stopping.is_set():
                return None
            log.warning("job %s: %s", record.id, error)
            self._deaths[record.id] += 1  # a killed server is not the job's fault
            if self._deaths[record.id] >= _MOST_DEATHS:
                return JobOutcome(error_kind="worker died", error=str(error))
            return None

    def task(self, id: str) -> JobTask:
        """What the process of a job gets."""
        return JobTask(
            self._table.request(id), self._folder.of_job(id), self._roots, self._settings
        )

    def _renew(self, slot: _Slot, *, failed: bool) -> None:
        """End a process that has run many jobs, or one that failed: it may be in disorder."""
        slot.jobs += 1
        if failed or slot.jobs >= _JOBS_PER_CHILD:
            slot.child.stop()
            slot.jobs = 0

    def _keep_result(self, id: str) -> None:
        folder = self._folder.of_job(id)
        shutil.rmtree(folder / RESULT, ignore_errors=True)
        (folder / WORK).rename(folder / RESULT)

    def _is_finished(self, id: str) -> bool:
        record = self._table.get(id)
        return record is None or record.is_finished

    def _discard_input(self, id: str) -> None:
        """Remove all of a finished job that is not its result."""
        for name in (INPUT, WORK):
            remove_folder(self._folder.of_job(id) / name)

    def _expire(self) -> None:
        """A thread: remove the jobs whose results have been kept for long enough."""
        while not self._is_stopping.wait(_EXPIRE_EVERY_S):
            try:
                self.remove_expired()
            except (SQLAlchemyError, OSError):
                log.exception("expired jobs cannot be removed")

    def remove_expired(self) -> None:
        """Remove the jobs whose results have been kept for long enough, and their folders."""
        ids = self._table.finished_before(time.time() - self._settings.keep_s)
        self._table.remove(ids)
        for id in ids:
            remove_folder(self._folder.of_job(id))

    def _remove_leftovers(self) -> None:
        """Remove the folders of jobs that are not known, and the input of those that ended."""
        states = self._table.states()
        for folder in self._folder.jobs.iterdir():
            if folder.name not in states:
                remove_folder(folder)
            elif states[folder.name] in FINISHED:
                self._discard_input(folder.name)


_MOST_DEATHS = min(5, MOST_STARTS)
"""Deaths of a job's process, while one server runs, after which they are its own fault."""
