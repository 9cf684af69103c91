"""Runs the jobs of the table, each in a child process, and keeps the table in order."""

import logging
import shutil
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

from calibgraph.child_process import ChildEndedError, ChildProcess, ChildTimeoutError, Outcome
from calibgraph.service.folders import INPUT, RESULT, SCRATCH, WORK, DataFolder
from calibgraph.service.jobs import FINISHED, JobRecord, JobTable
from calibgraph.service.requests import Job, JobProgress, JobTask, Settings

log = logging.getLogger("calibgraph.service")

_CHILD = "calibgraph.service.job_process"
_JOBS_PER_CHILD = 200
"""Then a new process takes its place: leaks of libraries do not add up."""
_LOOK_EVERY_S = 1.0
_RETRY_AFTER_S = 2.0  # when the table cannot be used


@dataclass
class _Slot:
    """A thread's child process, and the job in it."""

    child: ChildProcess = field(default_factory=lambda: ChildProcess(_CHILD))
    job: str | None = None
    jobs: int = 0


class Runner:
    """The threads that run jobs.

    Attributes:
        steps: how far running jobs are, by their ids.
        added: to be set when a job was added.
    """

    def __init__(self, table: JobTable, folder: DataFolder, settings: Settings) -> None:
        self._table, self._folder, self._settings = table, folder, settings
        self.steps: dict[str, JobProgress] = {}
        self._slots = [_Slot() for _ in range(settings.jobs_at_once)]
        self._threads: list[threading.Thread] = []
        self._taking, self.added = threading.Lock(), threading.Event()
        self._is_stopping = threading.Event()

    def start(self) -> None:
        """Put back what an earlier server left running, and begin."""
        if again := self._table.put_back():
            log.info("%d jobs that an earlier server had begun are run again", again)
        self._remove_leftovers()
        for slot in self._slots:
            thread = threading.Thread(target=self._work, args=(slot,), daemon=True)
            thread.start()
            self._threads.append(thread)

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
        self.added.set()

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
                self.added.clear()
                if slot.job is not None:  # what it came to could not be written
                    self._table.put_back(slot.job)
                with self._taking:
                    record = self._table.start_next()
                    slot.job = None if record is None else record.id
                if record is None:
                    self.added.wait(_LOOK_EVERY_S)
                else:
                    self._run(slot, record)
            except Exception:  # of the database, of the disk
                log.exception("the table of jobs or the data folder cannot be used")
                slot.child.stop()
                self._is_stopping.wait(_RETRY_AFTER_S)

    def _run(self, slot: _Slot, record: JobRecord) -> None:
        """Run a job and write down how it ended."""
        outcome = self._ask(slot, record)
        if outcome is None:  # the server stops, or the process died: it waits again
            self._table.put_back(record.id)
        else:
            if outcome.error_kind is None:
                folder = self._folder.of_job(record.id)
                shutil.rmtree(folder / RESULT, ignore_errors=True)
                (folder / WORK).rename(folder / RESULT)
            self._table.finish(record.id, outcome)
        if (known := self._table.get(record.id)) is None or known.is_finished:
            self._discard_input(record.id)
        with self._taking:
            slot.job = None
        self.steps.pop(record.id, None)

    def _ask(self, slot: _Slot, record: JobRecord) -> Outcome | None:
        """What the child answers; None if the job is to wait again."""
        try:
            slot.child.start()
            current = self._table.get(record.id)
            if current is None or current.state != "running":  # cancelled meanwhile
                return Outcome(error_kind="bad input", error="cancelled")
            outcome: Outcome = slot.child.ask(
                self.task(record),
                self._settings.job_timeout_s,
                partial(self.steps.__setitem__, record.id),
            )
            slot.jobs += 1
            if outcome.error_kind is not None or slot.jobs >= _JOBS_PER_CHILD:
                slot.child.stop()  # it has run many jobs, or may be in disorder
                slot.jobs = 0
            return outcome
        except ChildTimeoutError as error:
            return Outcome(error_kind="timeout", error=f"{error}; give fewer frames")
        except ChildEndedError as error:
            slot.child.stop()
            if not self._is_stopping.is_set():
                log.warning("job %s: %s", record.id, error)
            return None

    def task(self, record: JobRecord) -> JobTask:
        """What the process of a job gets."""
        job, folder = Job.model_validate_json(record.request), self._folder.of_job(record.id)
        return JobTask(job, folder, self._settings)

    def _discard_input(self, id: str) -> None:
        """Remove all of a finished job that is not its result."""
        for name in (INPUT, SCRATCH, WORK):
            shutil.rmtree(self._folder.of_job(id) / name, ignore_errors=True)

    def remove_expired(self) -> None:
        """Remove the jobs whose results have been kept for long enough, and their folders."""
        for id in self._table.remove_finished(time.time() - self._settings.keep_s):
            shutil.rmtree(self._folder.of_job(id), ignore_errors=True)

    def _remove_leftovers(self) -> None:
        """Remove the folders of jobs that are not known, and the input of those that ended."""
        states = self._table.states()
        for folder in self._folder.jobs.iterdir():
            if folder.name not in states:
                shutil.rmtree(folder, ignore_errors=True)
            elif states[folder.name] in FINISHED:
                self._discard_input(folder.name)
