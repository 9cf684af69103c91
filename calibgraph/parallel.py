"""Threads: as many as there are cores, and values that they make once."""

import os
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from threading import Lock
from typing import Any, Generic, ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")
Result = TypeVar("Result")
Parameters = ParamSpec("Parameters")


THREADS_VARIABLE = "CALIBGRAPH_THREADS"
"""In the environment: how many cores a process uses that shares them with others."""


def count_cores() -> int:
    """The number of cores that this process may use."""
    given = os.environ.get(THREADS_VARIABLE, "")
    if given.isdecimal() and int(given):
        return int(given)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on Linux
        return os.cpu_count() or 1


def core_pool() -> ThreadPoolExecutor:
    """A thread per core, for work that waits for nothing but a core."""
    return ThreadPoolExecutor(count_cores())


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
    """The function, in whose time BLAS takes one thread: it has a thread per core of its own.

    The threads of OpenBLAS wait for the next of our small products without sleep, for which half as
    many processor seconds again went, and took the cores from ours.
    """

    @wraps(function)
    def run(*arguments: Parameters.args, **options: Parameters.kwargs) -> Result:
        with _controller().limit(limits=1, user_api="blas"):
            return function(*arguments, **options)

    return run


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()  # it looks for the libraries that are loaded: milliseconds


class KeyedCache(Generic[Key, Value]):
    """Values by key, each made by the first thread that needs it; the one used last comes last."""

    def __init__(self) -> None:
        self._lock = Lock()
        self._being_made: dict[Key, Lock] = {}
        self._values: OrderedDict[Key, Value] = OrderedDict()

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """The value of a key. Another thread that needs it meanwhile waits until it is made."""
        with self._lock:
            being_made = self._being_made.setdefault(key, Lock())
        with being_made:
            value = self._values[key] if key in self._values else make()
            with self._lock:
                self._values[key] = value
                self._values.move_to_end(key)
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

    def keep_last(self, most: float, size: Callable[[Value], float]) -> None:
        """Drop the values that were used longest ago, until the others' sizes sum to the most."""
        with self._lock:
            total = sum(size(value) for value in self._values.values())
            for key in list(self._values)[:-1]:
                if total <= most:
                    break
                total -= size(self._values.pop(key))
                del self._being_made[key]
