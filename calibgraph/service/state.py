"""A server: its data folder, its jobs and the processes that run them, its trackers."""

import asyncio
import logging
import shutil
import threading
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from fastapi import Request

from calibgraph.child_process import ChildEndedError, ChildProcess, Outcome
from calibgraph.files import require_place_for_folder, sync_to_disk
from calibgraph.service.jobs import FINISHED, JobRecord, JobTable
from calibgraph.service.problems import Problem
from calibgraph.service.request_guard import load_tokens
from calibgraph.service.requests import (
    INPUT,
    RESULT,
    SCRATCH,
    WORK,
    Job,
    JobProgress,
    JobTask,
    Settings,
)

log = logging.getLogger("calibgraph.service")

_JOBS_PER_CHILD = 200
"""Then a new process takes its place: leaks of libraries do not add up."""
_LOOK_EVERY_S = 1.0
_RETRY_AFTER_S = 2.0  # when the table cannot be used


class Service:
    """The parts of a server, and the threads that run its jobs, each in a child process.

    Attributes:
        path: its data folder.
        arriving: the folder of uploads.
        steps: how far running jobs are, by their ids.

    Raises:
        CalibrationError: if the token file, the data folder or the database cannot be used, or
            another server uses them.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.tokens = None if settings.tokens is None else load_tokens(settings.tokens)
        require_place_for_folder(settings.data)
        settings.data.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.path = settings.data.resolve()
        self.jobs = JobTable(self.path)  # which no other server uses
        self.arriving, trackers = self.path / "arriving", self.path / "trackers"
        shutil.rmtree(self.arriving, ignore_errors=True)
        for folder in (self.of_job(""), self.arriving, trackers):
            folder.mkdir(exist_ok=True, mode=0o700)
        self.trackers = Trackers(trackers, settings.tracker_processes, settings.memory_bytes)
        self.steps: dict[str, JobProgress] = {}
        module = f"{__package__}.job_process"
        self._children = [ChildProcess(module) for _ in range(settings.jobs_at_once)]
        self._threads: list[threading.Thread] = []
        self._running: dict[str, ChildProcess] = {}
        self._taking, self._added = threading.Lock(), threading.Event()
        self._stopping = threading.Event()

    @property
    def is_stopping(self) -> bool:
        """Whether nothing more is accepted."""
        return self._stopping.is_set()

    def start(self) -> None:
        """Put back what an earlier server left running, and begin."""
        if again := self.jobs.put_back():
            log.info("%d jobs that an earlier server had begun are run again", again)
        self._remove_leftovers()
        for child in self._children:
            thread = threading.Thread(target=self._work, args=(child,), daemon=True)
            thread.start()
            self._threads.append(thread)

    def begin_stop(self) -> None:
        """Accept nothing more, start no job, and let those go who wait."""
        self._stopping.set()
        self._added.set()

    def stop(self) -> None:
        """End the trackers and the jobs, which wait for the next server."""
        self.begin_stop()
        end = time.monotonic() + self.settings.grace_s
        for thread in self._threads:
            thread.join(max(0.0, end - time.monotonic()))
        for child in self._children:
            child.interrupt()
        for thread in self._threads:
            thread.join()
        for child in self._children:
            child.close()
        self.trackers.close()
        self.jobs.close()

    def require_room(self, size: int) -> None:
        """Refuse a body of so many bytes if there is no room: it is on the disk twice at first."""
        if self.is_stopping:
            raise Problem(503, "the server is being stopped; try again soon")
        if shutil.disk_usage(self.path).free - 2 * size < self.settings.free_bytes:
            self._remove_expired()
            raise Problem(507, "the server's disk has no room for it; try again later")

    def require_turn(self, size: int) -> None:
        """Refuse a job if too many wait, or if its form of so many bytes has no room."""
        self.require_room(size)
        waiting = self.jobs.counts().get("queued", 0)
        if waiting >= self.settings.most_queued:
            raise Problem(429, f"{waiting} jobs wait already; try again later")

    def of_job(self, id: str) -> Path:
        """The folder of a job."""
        return self.path / "jobs" / id

    def add(self, arrived: Path, job: Job) -> JobRecord:
        """Add a job by its folder, named as its id; both are durable when this returns."""
        self._remove_expired()
        for path in (*arrived.rglob("*"), arrived):
            sync_to_disk(path)
        id = arrived.name
        arrived.rename(self.of_job(id))
        try:
            sync_to_disk(self.of_job(""))
            record = self.jobs.add(id, job)
        except BaseException:
            shutil.rmtree(self.of_job(id), ignore_errors=True)
            raise
        self._added.set()
        return record

    def cancel(self, id: str) -> bool:
        """Cancel a job; False if it is finished."""
        if not self.jobs.cancel(id):
            return False
        with self._taking:
            child = self._running.get(id)
            if child is not None:
                child.kill()
        if child is None:
            self._discard_input(id)
        return True

    def task(self, record: JobRecord) -> JobTask:
        """What the process of a job gets."""
        job = Job.model_validate_json(record.request)
        return JobTask(job, self.of_job(record.id), self.settings)

    def _work(self, child: ChildProcess) -> None:
        """A thread: one job after the other."""
        taken, done = None, 0
        while not self.is_stopping:
            try:
                with suppress(ChildEndedError):  # no job dies while libraries load
                    child.start()
                self._added.clear()
                if taken is not None:  # what it came to could not be written
                    self.jobs.put_back(taken.id)
                with self._taking:
                    taken = self.jobs.start_next()
                    if taken is not None:
                        self._running[taken.id] = child
                if taken is None:
                    self._added.wait(_LOOK_EVERY_S)
                    continue
                self._run(child, taken)
                taken, done = None, done + 1
                if done % _JOBS_PER_CHILD == 0:
                    child.stop()
            except Exception:  # of the database, of the disk
                log.exception("the table of jobs or the data folder cannot be used")
                child.stop()
                self._stopping.wait(_RETRY_AFTER_S)

    def _run(self, child: ChildProcess, record: JobRecord) -> None:
        """Run a job and write down how it ended."""
        try:
            outcome = self._ask(child, record)
            if outcome is None:
                self.jobs.put_back(record.id)
            else:
                if outcome.error_kind is None:
                    folder = self.of_job(record.id)
                    shutil.rmtree(folder / RESULT, ignore_errors=True)
                    (folder / WORK).rename(folder / RESULT)
                else:
                    child.stop()  # it may be in disorder
                self.jobs.finish(record.id, outcome)
            if (known := self.jobs.get(record.id)) is None or known.is_finished:
                self._discard_input(record.id)
        finally:
            with self._taking:
                del self._running[record.id]
            self.steps.pop(record.id, None)

    def _ask(self, child: ChildProcess, record: JobRecord) -> Outcome | None:
        """What the child answers; None if it ended or the job was cancelled before."""
        try:
            child.start()
            if (known := self.jobs.get(record.id)) is None or known.is_finished:
                return None
            note, most_s = partial(self.steps.__setitem__, record.id), self.settings.job_timeout_s
            return child.ask(self.task(record), most_s, note)  # type: ignore[no-any-return]
        except ChildEndedError as error:
            if error.kind == "timeout":
                return Outcome(error_kind="timeout", error=f"{error}; give fewer frames")
            if not self.is_stopping:
                log.warning("job %s: %s", record.id, error)
            return None

    def _discard_input(self, id: str) -> None:
        """Remove all of a finished job that is not its result."""
        for name in (INPUT, SCRATCH, WORK):
            shutil.rmtree(self.of_job(id) / name, ignore_errors=True)

    def _remove_expired(self) -> None:
        """Remove the jobs whose results have been kept for long enough, and their folders."""
        for id in self.jobs.remove_finished(time.time() - self.settings.keep_s):
            shutil.rmtree(self.of_job(id), ignore_errors=True)

    def _remove_leftovers(self) -> None:
        """Remove the folders of jobs that are not known, and the input of those that ended."""
        states = self.jobs.states()
        for folder in self.of_job("").iterdir():
            if folder.name not in states:
                shutil.rmtree(folder, ignore_errors=True)
            elif states[folder.name] in FINISHED:
                self._discard_input(folder.name)


async def service_of(request: Request) -> Service:
    """The parts of the server that a request is for."""
    return request.app.state.service  # type: ignore[no-any-return]


class Trackers:
    """The processes that hold the trackers; each tracker is in one of them."""

    def __init__(self, folder: Path, processes: int, memory_bytes: int) -> None:
        self.folder, child = folder, (f"{__package__}.tracker_process", (str(memory_bytes),))
        self._hosts = [(ChildProcess(*child), ThreadPoolExecutor(1)) for _ in range(processes)]

    async def ask(self, method: str, name: str, body: bytes, config: str) -> str:
        """What the process of a tracker answers; a :class:`Problem` if it refuses."""
        child, pool = self._hosts[zlib.crc32(name.encode()) % len(self._hosts)]
        request, loop = (method, self.folder / name, body, config), asyncio.get_running_loop()
        status, text = await loop.run_in_executor(pool, _ask, child, request)
        if status == 200:  # noqa: PLR2004
            return text
        raise Problem(status, text)

    def close(self) -> None:
        """End the processes; what they answered is on disk."""
        for child, pool in self._hosts:
            pool.shutdown(cancel_futures=True)
            child.close()


def _ask(child: ChildProcess, request: Any) -> tuple[int, str]:
    try:
        child.start()
        return child.ask(request, 120.0)  # type: ignore[no-any-return]
    except ChildEndedError as error:
        return 503, f"{error}; send the frames again: those that were taken in are known"
