"""Trackers over HTTP: bytes of frames in, the updates that ``track`` prints out, on disk first."""

import asyncio
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from pydantic import StringConstraints

from calibgraph.child_process import ChildEndedError, ChildProcess, ChildTimeoutError
from calibgraph.service.problems import Problem

Name = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}$")]
router = APIRouter(prefix="/v1/trackers")


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


async def _tracker(name: Name, request: Request, config: str = "{}") -> Response:
    """PUT a rig file to begin, POST frames (JSON lines), GET the last estimate, DELETE it."""
    trackers: Trackers = request.app.state.service.trackers
    text = await trackers.ask(request.method, name, await request.body(), config)
    return Response(text, media_type="application/json")


for _method in ("PUT", "POST", "GET", "DELETE"):
    router.add_api_route("/{name}", _tracker, methods=[_method])
