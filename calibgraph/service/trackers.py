"""Trackers over HTTP: bytes of frames in, the updates that ``track`` prints out, on disk first."""

import asyncio
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from fastapi import Path as PathParameter

from calibgraph.child_process import ChildEndedError, ChildProcess, ChildTimeoutError
from calibgraph.service.problems import Problem

Name = Annotated[str, PathParameter(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}$")]
router = APIRouter(prefix="/v1/trackers")


class Trackers:
    """The processes that hold the trackers; each tracker is in one of them."""

    def __init__(self, folder: Path, processes: int, memory_bytes: int) -> None:
        self.folder, self.frames = folder, 0
        hosts = (ChildProcess(f"{__package__}.tracker_process", (str(memory_bytes),))
                 for _ in range(processes))  # fmt: skip
        self._hosts = [(child, ThreadPoolExecutor(1)) for child in hosts]

    async def ask(self, method: str, name: str, body: bytes, config: str) -> str:
        """What the process of a tracker answers; a :class:`Problem` if it refuses."""
        if not self._hosts:
            raise Problem(503, "this server has no trackers (--tracker-processes 0)")
        child, pool = self._hosts[zlib.crc32(name.encode()) % len(self._hosts)]
        request, loop = (method, self.folder / name, body, config), asyncio.get_running_loop()
        status, text, frames = await loop.run_in_executor(pool, _ask, child, request)
        if status != 200:  # noqa: PLR2004
            raise Problem(status, text)
        self.frames += frames
        return str(text)

    def close(self) -> None:
        """End the processes; what they answered is on disk."""
        for child, pool in self._hosts:
            pool.shutdown(cancel_futures=True)
            child.close()


def _ask(child: ChildProcess, request: Any) -> Any:
    try:
        child.start()
        return child.ask(request, 120.0)
    except (ChildEndedError, ChildTimeoutError) as error:
        child.stop()
        return 503, f"{error}; send the frames again: those that were taken in are known", 0


@router.get("")
def list_trackers(request: Request) -> list[str]:
    """The names of the trackers."""
    folder: Path = request.app.state.service.trackers.folder
    return sorted(path.parent.name for path in folder.glob("*/rig.yaml"))


async def _tracker(name: Name, request: Request, config: str = "{}") -> Response:
    service, method = request.app.state.service, request.method
    if method in ("PUT", "POST"):
        service.require_room(0)
    text = await service.trackers.ask(method, name, await request.body(), config)
    return Response(text, media_type="application/json")


for _what, _method in {
    "Begin to track: the body is a rig file, config JSON of settings.": "PUT",
    "Take in frames, a line of JSON each; what is answered is on disk.": "POST",
    "The last estimate, as --json prints a result, and its frame.": "GET",
    "Remove a tracker and its state.": "DELETE",
}.items():
    router.add_api_route("/{name}", _tracker, methods=[_method], description=_what)
