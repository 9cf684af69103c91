"""What the routes of a server share."""

import asyncio
import shutil
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from fastapi import Request

from calibgraph.child_process import ChildEndedError, ChildProcess, ChildTimeoutError
from calibgraph.errors import CalibrationError
from calibgraph.service.folders import DataFolder
from calibgraph.service.jobs import JobRecord, JobTable
from calibgraph.service.problems import Problem
from calibgraph.service.request_guard import load_tokens
from calibgraph.service.requests import Job, Settings
from calibgraph.service.runner import Runner


class Service:
    """The parts of a server.

    Raises:
        CalibrationError: if the token file, the data folder or the database cannot be used.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings, self.is_stopping = settings, False
        self.tokens = None if settings.tokens is None else load_tokens(settings.tokens)
        self.folder = DataFolder(settings.data)
        try:
            self.jobs = JobTable(self.folder.path)
        except CalibrationError:
            self.folder.close()
            raise
        self.runner = Runner(self.jobs, self.folder, settings)
        self.trackers = Trackers(
            self.folder.trackers, settings.tracker_processes, settings.memory_bytes
        )

    def begin_stop(self) -> None:
        """Accept nothing more, and let those go who wait."""
        self.is_stopping = True
        self.runner.begin_stop()

    def stop(self) -> None:
        """End the jobs and trackers, and release the data folder."""
        self.begin_stop()
        self.runner.stop(self.settings.grace_s)
        self.trackers.close()
        self.jobs.close()
        self.folder.close()

    def require_room(self, size: int) -> None:
        """Refuse a body of so many bytes if there is no room: it is on the disk twice at first."""
        if self.is_stopping:
            raise Problem(503, "the server is being stopped; try again soon")
        if shutil.disk_usage(self.folder.path).free - 2 * size < self.settings.free_bytes:
            self.runner.remove_expired()
            raise Problem(507, "the server's disk has no room for it; try again later")

    def add(self, id: str, job: Job) -> JobRecord:
        """Add a job whose folder is in its place; it is durable when this returns."""
        self.runner.remove_expired()
        try:
            waiting = self.jobs.counts().get("queued", 0)
            if waiting >= self.settings.most_queued:
                raise Problem(429, f"{waiting} jobs wait already; try again later")
            record = self.jobs.add(id, job)
        except BaseException:
            shutil.rmtree(self.folder.of_job(id), ignore_errors=True)
            raise
        self.runner.added.set()
        return record


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
    except (ChildEndedError, ChildTimeoutError) as error:
        child.stop()
        return 503, f"{error}; send the frames again: those that were taken in are known"
