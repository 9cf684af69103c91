"""Waiting, in the event loop, for what threads do to a job."""

from __future__ import annotations

import asyncio
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class Bell:
    """Wakes the requests that wait for a job, from any thread; a request is a task of the loop."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: defaultdict[str, set[asyncio.Event]] = defaultdict(set)

    def open(self) -> None:
        """Begin, in the event loop."""
        self._loop = asyncio.get_running_loop()

    def ring(self, id: str) -> None:
        """Wake those who wait for an id, from any thread."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._set, id)

    def ring_all(self) -> None:
        """Wake all, from any thread or a handler of signals."""
        loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._set_all)

    @contextmanager
    def listen(self, *ids: str) -> Iterator[asyncio.Event]:
        """An event that is set whenever something happens to one of these."""
        heard = asyncio.Event()
        for id in ids:
            self._waiting[id].add(heard)
        try:
            yield heard
        finally:
            for id in ids:
                self._waiting[id].discard(heard)
                if not self._waiting[id]:
                    del self._waiting[id]

    def _set_all(self) -> None:
        for id in list(self._waiting):
            self._set(id)

    def _set(self, id: str) -> None:
        for heard in self._waiting.get(id, ()):
            heard.set()


def progress_of(id: str) -> str:
    """What is rung when a job gets on, apart from its changes of state."""
    return f"{id} progress"


async def wait_for(heard: asyncio.Event, seconds: float) -> None:
    """Wait until an event is set, not longer than these seconds; then clear it."""
    with suppress(TimeoutError):
        await asyncio.wait_for(heard.wait(), seconds)
    heard.clear()
