"""The processes that hold the trackers; each tracker is in one of them."""

import asyncio
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from calibgraph.child_process import ChildEndedError, ChildProcess, ChildTimeoutError
from calibgraph.service.folders import DataFolder
from calibgraph.service.problems import Problem
from calibgraph.service.settings import Settings
from calibgraph.service.tracker_request import Refusal, TrackerRequest

_CHILD = "calibgraph.service.tracker_process"
_TIMEOUT_S = 120.0
_MOST_AT_ONCE = 64
_MOST_BYTES_AT_ONCE = 2 * 2**20
"""A few seconds of work: small frames take a millisecond a kilobyte."""
_MOST_WAITING = 512
_MOST_BYTES_WAITING = 64 * 2**20
"""Of one tenant, for one process."""
_AGAIN = {"Retry-After": "1"}
_KNOWN = "frames that were taken in are known"


@dataclass(frozen=True)
class _Asked:
    request: TrackerRequest
    answer: Future[Any]


class _Host:
    """A process with trackers: what was asked meanwhile is asked together, by turns of tenants."""

    def __init__(self, memory_bytes: int) -> None:
        self._child = ChildProcess(_CHILD, (str(memory_bytes),))
        self._waiting: OrderedDict[str, deque[_Asked]] = OrderedDict()
        self._changed = threading.Condition()
        self._is_closed = False
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def ask(self, tenant: str, request: TrackerRequest) -> Future[Any]:
        """The answer, when it has come."""
        asked = _Asked(request, Future())
        with self._changed:
            if self._is_closed:
                raise _stopping()
            waiting = self._waiting.setdefault(tenant, deque())
            size = sum(len(each.request.body) for each in waiting)
            if len(waiting) >= _MOST_WAITING or size > _MOST_BYTES_WAITING:
                raise Problem(429, "the trackers are behind; send the frames again later", _AGAIN)
            waiting.append(asked)
            self._changed.notify()
        return asked.answer

    def _work(self) -> None:
        while together := self._take():
            self._answer(together)
        self._child.close()

    def _take(self) -> list[_Asked]:
        """What is next, some seconds of work; nothing when all is done and closed."""
        together: list[_Asked] = []
        size = 0
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            while self._waiting and len(together) < _MOST_AT_ONCE:
                tenant, waiting = next(iter(self._waiting.items()))
                size += len(waiting[0].request.body)
                if together and size > _MOST_BYTES_AT_ONCE:
                    break
                together.append(waiting.popleft())
                self._waiting.move_to_end(tenant)
                if not waiting:
                    del self._waiting[tenant]
        return together

    def _answer(self, together: list[_Asked]) -> None:
        def give(note: tuple[int, Any]) -> None:
            which, answer = note
            together[which].answer.set_result(answer)

        try:
            self._child.start()
            self._child.ask([asked.request for asked in together], _TIMEOUT_S, give)
        except (ChildEndedError, ChildTimeoutError) as error:
            self._child.stop()
            for asked in together:
                if not asked.answer.done():
                    asked.answer.set_exception(error)

    def close(self) -> None:
        """Let what was asked be answered, then write all states and end."""
        with self._changed:
            if not self._is_closed:
                last = _Asked(TrackerRequest("close all", ""), Future())
                self._waiting[""] = deque([last])  # no tenant has this name
            self._is_closed = True
            self._changed.notify()
        self._thread.join()


def _stopping() -> Problem:
    return Problem(503, "the server is being stopped; try again soon", _AGAIN)


class Trackers:
    """All trackers of a server."""

    def __init__(self, folder: DataFolder, settings: Settings) -> None:
        self._folder, self._settings = folder, settings
        self._hosts: list[_Host] = []
        self._begun: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._is_closed = False

    @contextmanager
    def begin(self, tenant: str) -> Iterator[int]:
        """Begin a tracker, in the event loop; how many the tenant begins at present."""
        self._begun[tenant] += 1
        try:
            yield self._begun[tenant]
        finally:
            self._begun[tenant] -= 1

    async def answer(self, id: str, tenant: str, request: TrackerRequest) -> Any:
        """Ask the process of a tracker; tenants take turns, and no thread waits for the answer.

        Raises:
            Problem: if it is refused, too much waits, or the process ended: then it may be asked
                again.
        """
        asked = self._host(id).ask(tenant, request)
        await asyncio.wait([asyncio.wrap_future(asked)])
        return _checked(asked.result)

    def _host(self, id: str) -> _Host:
        with self._lock:
            if self._is_closed:
                raise _stopping()
            if not self._hosts:
                memory = self._settings.tracker_memory_bytes
                self._hosts = [_Host(memory) for _ in range(self._settings.tracker_processes)]
        if not self._hosts:
            raise Problem(503, "this server has no trackers (--tracker-processes 0)")
        return self._hosts[int(id[:8], 16) % len(self._hosts)]

    def close(self) -> None:
        """End the processes, with all states on disk."""
        with self._lock:
            self._is_closed = True
        for host in self._hosts:
            host.close()


def _checked(result: Callable[[], Any]) -> Any:
    """An answer that is none of the refusals."""
    try:
        answer = result()
    except ChildEndedError:
        raise Problem(503, f"the tracker's process ended; ask again: {_KNOWN}", _AGAIN) from None
    except ChildTimeoutError:
        text = f"the tracker is busy; send fewer frames at once: {_KNOWN}"
        raise Problem(503, text, _AGAIN) from None
    if isinstance(answer, Refusal):
        raise Problem(answer.status, answer.detail)
    return answer
