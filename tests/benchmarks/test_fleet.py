from __future__ import annotations

import numpy as np
import pytest

from benchmarks.fleet.simulation import Plan, simulate

RNG = np.random.default_rng


def test_equal_jobs_take_their_number_over_the_slots() -> None:
    found = simulate(np.full(100, 2.0), Plan(slots=10, driver_s=0.0, start_s=3.0), RNG(0))
    assert found.wall_s == pytest.approx(3.0 + 100 * 2.0 / 10)
    assert found.slot_use == pytest.approx(200 / (10 * 23.0))
    assert (found.retries, found.failed) == (0, 0)


def test_a_slow_driver_bounds_the_throughput() -> None:
    found = simulate(np.full(1000, 1.0), Plan(slots=100, driver_s=0.1, start_s=0.0), RNG(0))
    # The driver needs 100 s for 1000 outcomes, the slots 10 s: the first outcome comes after 1 s.
    assert found.wall_s == pytest.approx(101.0)
    assert found.driver_use == pytest.approx(100 / 101)


def test_losses_are_retried_and_stragglers_end_at_the_time_limit() -> None:
    plan = Plan(slots=10, driver_s=0.0, start_s=0.0, losses_per_hour=360.0)
    found = simulate(np.full(2000, 1.0), plan, RNG(0))
    # A try of 1 s is lost with probability 1 - exp(-0.1) = 0.095: 2000 jobs take 210 retries, with
    # a standard deviation of 2000^0.5 * 0.095^0.5 / 0.905 = 15; four of them.
    assert abs(found.retries - 210) < 60
    assert found.failed <= 3  # 0.16 expected
    slow = Plan(slots=1, driver_s=0.0, start_s=0.0, straggler_share=1.0, straggler_factor=9.0,
                timeout_s=5.0)  # fmt: skip
    found = simulate(np.full(1, 1.0), slow, RNG(0))
    assert (found.wall_s, found.retries, found.failed) == (10.0, 1, 1)
