from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from threadpoolctl import threadpool_info, threadpool_limits

from calibgraph.parallel import Threads, with_own_threads


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
