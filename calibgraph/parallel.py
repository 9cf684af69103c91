"""Threads: as many as there are cores, and values that they make once."""

import math
import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from threading import Lock
from typing import Any, Generic, ParamSpec, TypeVar

import numpy as np
from threadpoolctl import OpenBLASController, ThreadpoolController

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")
Result = TypeVar("Result")
Parameters = ParamSpec("Parameters")


THREADS_VARIABLE = "CALIBGRAPH_THREADS"
"""In the environment: how many cores a process uses that shares them with others."""

_REUSED_BYTES = 31 << 20  # glibc follows up to 32 MB


def count_cores() -> int:
    """The number of cores that this process may use."""
    given = os.environ.get(THREADS_VARIABLE, "")
    if given.isdecimal() and int(given):
        return int(given)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


class Threads(ThreadPoolExecutor):
    """A pool whose work is given up where Ctrl-C ends the body of its ``with``."""

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Wait for its work, but not after an interrupt."""
        interrupted = kind is not None and not issubclass(kind, Exception)
        self.shutdown(wait=not interrupted, cancel_futures=interrupted)


def core_pool() -> ThreadPoolExecutor:
    """A thread per core, for work that waits for nothing but a core."""
    return Threads(count_cores())


@cache
def _kept_pool() -> ThreadPoolExecutor:
    return core_pool()


os.register_at_fork(after_in_child=_kept_pool.cache_clear)  # whose threads the parent keeps


def map_on_cores(function: Callable[..., Result], *arguments: Sequence[Any]) -> list[Result]:
    """``map`` on all cores, by threads that are kept: for work of milliseconds.

    Starting threads, and their fresh memory, would take a tenth of it. The function itself must not
    map on cores: its thread would wait for itself.
    """
    if min(map(len, arguments)) <= 1 or count_cores() == 1:
        return [*map(function, *arguments)]
    return [*_kept_pool().map(function, *arguments)]


def with_own_threads(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Run the function with BLAS limited to one thread, and with memory that is used again.

    OpenBLAS threads spin between small products; that cost 50 % more processor time.
    """

    @wraps(function)
    def run(*arguments: Parameters.args, **options: Parameters.kwargs) -> Result:
        _reuse_memory()
        with _one_blas_thread:
            return function(*arguments, **options)

    return run


@cache
def _reuse_memory() -> None:
    """Free a large array once: glibc then keeps arrays that are as large, where they are freed.

    Else it gives them back at once, and fresh pages cost a sixth of the time of a solve. It keeps
    twice as much at most, 64 MB; other allocators take no notice.
    """
    np.empty(_REUSED_BYTES, dtype=np.uint8)


class _OneBlasThread:
    """The limit of BLAS, which is the process's: the first to enter sets it, the last lifts it."""

    def __init__(self) -> None:
        self.lock, self._inside = Lock(), 0
        self._lift: Callable[[], None] = lambda: None

    def __enter__(self) -> None:
        with self.lock:
            if not self._inside:
                limit = _in_any_thread(lambda: _controller().limit(limits=1, user_api="blas"))
                self._lift = limit.restore_original_limits
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self.lock:
            self._inside -= 1
            if not self._inside:
                _in_any_thread(self._lift)


def _in_any_thread(change: Callable[[], Result]) -> Result:
    """Change the limit, which otherwise only the thread can that changed it first."""
    OpenBLASController.clear_controlling_thread(force=True)
    try:
        return change()
    finally:
        OpenBLASController.clear_controlling_thread(force=True)


_one_blas_thread = _OneBlasThread()
_lock = _one_blas_thread.lock
os.register_at_fork(  # a child would find it held for good
    before=_lock.acquire, after_in_child=_lock.release, after_in_parent=_lock.release
)


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()  # it looks for the libraries that are loaded: milliseconds


class KeyedCache(Generic[Key, Value]):
    """Values by key, each made by the first thread that needs it; the one used last comes last.

    Args:
        most_bytes: when another value is made, those that were used longest ago are dropped until
            the sizes of the others, their ``nbytes``, sum to this.
    """

    def __init__(self, most_bytes: float = math.inf) -> None:
        self._lock, self._most_bytes = Lock(), most_bytes
        self._being_made: dict[Key, Lock] = {}
        self._values: OrderedDict[Key, Value] = OrderedDict()

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """The value of a key. Another thread that needs it meanwhile waits until it is made."""
        with self._lock:
            being_made = self._being_made.setdefault(key, Lock())
        with being_made:
            try:
                value, is_new = self._values[key], False
            except KeyError:
                value, is_new = make(), True
            with self._lock:
                self._values[key] = value
                self._values.move_to_end(key)
                if is_new and self._most_bytes < math.inf:
                    self._keep_last()
        return value

    def values(self) -> list[Value]:
        """All values."""
        with self._lock:
            return list(self._values.values())

    def keep_only(self, wanted: Callable[[Key], bool]) -> None:
        """Drop the values of all other keys."""
        with self._lock:
            for key in [key for key in self._values if not wanted(key)]:
                del self._values[key], self._being_made[key]

    def _keep_last(self) -> None:
        total = sum(value.nbytes for value in self._values.values())  # type: ignore[attr-defined]
        for key in list(self._values)[:-1]:
            if total <= self._most_bytes:
                break
            total -= self._values.pop(key).nbytes  # type: ignore[attr-defined]
            del self._being_made[key]
