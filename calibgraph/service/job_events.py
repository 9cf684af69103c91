"""Waiting, in the event loop, for what threads do to a job."""

import asyncio
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class JobEvents:
    """Wakes the requests that wait for a job, from any thread; a request is a task of the loop."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: defaultdict[str, set[asyncio.Event]] = defaultdict(set)

    def open(self) -> None:
        """Begin, in the event loop."""
        self._loop = asyncio.get_running_loop()

    def notify(self, id: str | None = None) -> None:
        """Wake those who wait for an id, or all, from any thread or a handler of signals."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._set, id)

    @contextmanager
    def listen(self, *ids: str) -> Iterator[asyncio.Event]:
        """An event that is set whenever one of these jobs changes."""
        changed = asyncio.Event()
        for id in ids:
            self._waiting[id].add(changed)
        try:
            yield changed
        finally:
            for id in ids:
                self._waiting[id].discard(changed)
                if not self._waiting[id]:
                    del self._waiting[id]

    def _set(self, id: str | None) -> None:
        for waiting in [*self._waiting] if id is None else [id]:
            for changed in self._waiting.get(waiting, ()):
                changed.set()


def progress_of(id: str) -> str:
    """The id under which progress of a job is notified; its changes of state have its own id."""
    return f"{id} progress"


async def wait_for(changed: asyncio.Event, seconds: float) -> None:
    """Wait until an event is set, not longer than these seconds; then clear it."""
    with suppress(TimeoutError):
        await asyncio.wait_for(changed.wait(), seconds)
    changed.clear()
