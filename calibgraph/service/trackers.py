"""The processes that hold the trackers; each tracker is in one of them."""

from __future__ import annotations

import queue
import threading
from concurrent.futures import Future
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
_AGAIN = {"Retry-After": "1"}


@dataclass(frozen=True)
class _Asked:
    request: TrackerRequest
    answer: Future[Any]


class _Host:
    """A process with trackers: what was asked meanwhile is asked together."""

    def __init__(self, memory_bytes: int) -> None:
        self._child = ChildProcess(_CHILD, (str(memory_bytes),))
        self._asked: queue.Queue[_Asked | None] = queue.Queue()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def ask(self, request: TrackerRequest) -> Any:
        asked = _Asked(request, Future())
        self._asked.put(asked)
        return asked.answer.result()

    def _work(self) -> None:
        while (first := self._asked.get()) is not None:
            together, is_last = [first], False
            while len(together) < _MOST_AT_ONCE and not self._asked.empty():
                another = self._asked.get()
                if another is None:
                    is_last = True
                    break
                together.append(another)
            self._answer(together)
            if is_last:
                break
        self._child.close()

    def _answer(self, together: list[_Asked]) -> None:
        try:
            self._child.start()
            answers = self._child.ask([asked.request for asked in together], _TIMEOUT_S)
            for asked, answer in zip(together, answers, strict=True):
                asked.answer.set_result(answer)
        except (ChildEndedError, ChildTimeoutError) as error:
            self._child.stop()
            for asked in together:
                if not asked.answer.done():
                    asked.answer.set_exception(error)

    def close(self) -> None:
        """Let what was asked be answered, then write all states and end."""
        closed = _Asked(TrackerRequest("close all", ""), Future())
        self._asked.put(closed)
        self._asked.put(None)
        self._thread.join()


class Trackers:
    """All trackers of a server.

    Args:
        folder: of the server.
        settings: of the server.
    """

    def __init__(self, folder: DataFolder, settings: Settings) -> None:
        self._folder, self._settings = folder, settings
        self._hosts: list[_Host] = []
        self._lock = threading.Lock()
        self._is_closed = False

    def ask(self, id: str, request: TrackerRequest) -> Any:
        """What the process of a tracker answers.

        Args:
            id: of the tracker.
            request: to it.

        Raises:
            Problem: if it is refused, or the process ended: then it may be asked again.
        """
        try:
            answer = self._host(id).ask(request)
        except ChildEndedError:
            text = "the tracker's process ended; ask again: frames that were taken in are known"
            raise Problem(503, text, _AGAIN) from None
        except ChildTimeoutError:
            raise Problem(503, "the tracker is busy; send fewer frames at once", _AGAIN) from None
        if isinstance(answer, Refusal):
            raise Problem(answer.status, answer.detail)
        return answer

    def _host(self, id: str) -> _Host:
        with self._lock:
            if self._is_closed:
                raise Problem(503, "the server is being stopped; try again soon", _AGAIN)
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
