"""Threads of a program: several calls at a time, and other work beside them."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from calibgraph import (
    Calibration,
    Correspondences,
    Rig,
    StructureMatcher,
    calibrate,
    load_dataset,
    simulate_correspondences,
    solve,
)
from calibgraph.parallel import Threads, with_own_threads
from factors import Lens, ProjectionBlock
from tests.conftest import SAMPLE, make_camera

RIG = Rig(
    cameras={
        "left": make_camera((0.2, 0.5, -0.1)),
        "right": make_camera((0.2, -0.5, -0.1), yaw_deg=-20.0),
    }
)


def bits(result: Calibration) -> list[bytes]:
    arrays = [*result.T_camera_lidar.values(), *result.covariance.values()]
    return [array.tobytes() for array in arrays] + [result.verdict.status.encode()]


def test_solves_in_threads_equal_solves_one_after_another() -> None:
    tables = [simulate_correspondences(RIG, frames=8, matches=300, seed=k) for k in range(3)]

    def run(table: Correspondences) -> list[bytes]:
        return bits(solve(RIG, table))

    alone = [run(table) for table in tables]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(run, tables * 2))
    assert together == alone * 2
    assert len({tuple(each) for each in alone}) == 3


@pytest.mark.slow
def test_calibrations_in_threads_equal_one_alone() -> None:
    def run(frames: str) -> list[bytes]:
        matcher = StructureMatcher(search_deg=None, search_m=None)
        return bits(calibrate(load_dataset(SAMPLE, frames=frames), matcher=matcher))

    alone = [run("0:4"), run("1:6")]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(run, ("0:4", "1:6"))) == alone


def test_another_thread_goes_on_while_a_kernel_runs() -> None:
    """If the kernel held the GIL, the other thread would make no turn until its end."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -2, 4), (3, 2, 30), (300_000, 3))
    lens = Lens.of("pinhole", fx=700.0, fy=700.0, cx=600.0, cy=200.0)
    block = ProjectionBlock(lens, points, lens.project(points)[0], scale=2.0)
    runs, T = np.tile([0, len(points)], (40, 1)), np.eye(4)[None]
    block.summarize(T, runs[:1])  # compiled
    with ThreadPoolExecutor(1) as pool:
        start = last = time.perf_counter()
        running, longest = pool.submit(block.summarize, T, runs), 0.0
        while not running.done():
            now = time.perf_counter()
            longest, last = max(longest, now - last), now
            time.sleep(0)
    assert longest < 0.5 * (last - start)


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
