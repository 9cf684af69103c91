from __future__ import annotations

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from calibgraph import pipeline
from calibgraph.parallel import KeyedCache, Threads, count_cores, with_own_threads


def test_a_value_is_made_once_for_all_threads_that_need_it() -> None:
    made: list[int] = []
    once: KeyedCache[str, int] = KeyedCache()
    barrier = threading.Barrier(4)

    def make() -> int:
        time.sleep(0.05)
        made.append(1)
        return 7

    def need(_: int) -> int:
        barrier.wait()
        return once.get("key", make)

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(need, range(4))) == [7] * 4
    assert made == [1]


def test_values_used_longest_ago_are_dropped_first() -> None:
    once: KeyedCache[str, int] = KeyedCache()
    for name, size in (("a", 3), ("b", 3), ("c", 3)):
        once.get(name, lambda size=size: size)
    once.get("a", lambda: 0)
    once.keep_last(7, float)
    assert once.get("a", lambda: -1) == 3  # used last
    assert once.get("b", lambda: -1) == -1  # dropped
    once.keep_only(lambda key: key == "c")
    assert once.values() == [3]


def test_there_is_a_core() -> None:
    assert count_cores() >= 1


def test_an_interrupt_does_not_wait_for_the_work_of_a_pool() -> None:
    first, done = threading.Event(), threading.Event()
    with suppress(KeyboardInterrupt), Threads(1) as pool:
        pool.submit(first.wait, 60.0)
        waiting = pool.submit(done.set)
        raise KeyboardInterrupt
    assert waiting.cancelled()
    first.set()
    assert not done.is_set()


def _blas_threads() -> set[int]:
    libraries = threadpool_info()
    return {library["num_threads"] for library in libraries if library["user_api"] == "blas"}


def test_blas_takes_one_thread_while_a_function_has_its_own() -> None:
    with threadpool_limits(2, user_api="blas"):
        assert with_own_threads(_blas_threads)() == {1}
        assert _blas_threads() == {2}


def test_blas_has_its_threads_again_after_an_error() -> None:
    with threadpool_limits(2, user_api="blas"):
        with pytest.raises(ZeroDivisionError):
            with_own_threads(divmod)(1, 0)
        assert _blas_threads() == {2}


def test_calls_that_overlap_leave_blas_its_threads() -> None:
    """The first to begin is the first to end, while the other goes on."""
    entered, over = threading.Event(), threading.Event()

    def wait() -> set[int]:
        entered.set()
        assert over.wait(60.0)
        return _blas_threads()

    def begin_another() -> Future[set[int]]:
        other = pool.submit(with_own_threads(wait))
        assert entered.wait(60.0)
        return other

    with threadpool_limits(2, user_api="blas"), ThreadPoolExecutor(1) as pool:
        other = with_own_threads(begin_another)()
        over.set()
        assert other.result() == {1}
        assert _blas_threads() == {2}


def test_calibrations_have_threads_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = list[set[int]]()

    def match(*arguments: object, **options: object) -> None:
        seen.append(_blas_threads())
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "match_in_rounds", match)
    with threadpool_limits(2, user_api="blas"), pytest.raises(KeyboardInterrupt):
        pipeline.calibrate("nowhere")
    assert seen == [{1}]
