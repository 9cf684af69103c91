"""One model for one vehicle and for many."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.audit.model import Limits, compare, poses_of, weigh, weighted_mean
from calibgraph.model.geometry import retract_all

SIGMA = np.array([np.radians(0.05)] * 3 + [0.005] * 3)


@pytest.mark.parametrize("moved", range(5))
def test_a_spread_of_zero_finds_the_result_that_drift_finds(moved: int) -> None:
    """By the posterior of the cases and by the test: the same one, the same centre, for one."""
    rng = np.random.default_rng(moved)
    y = rng.normal(size=(5, 6)) * SIGMA
    y[moved, moved] += 12 * SIGMA[moved]
    noise = np.tile(np.diag(SIGMA**2), (5, 1, 1))
    T = retract_all(np.tile(np.eye(4), (5, 1, 1)), -y)
    poses = poses_of([*range(5)], T, noise, np.full(5, 1e6))
    found = compare(poses, Limits(1e-4, np.full(2, 1e-9)))
    center, _ = weighted_mean(poses.twist[found.agreeing], poses.information[found.agreeing])
    spread = np.array([np.zeros((6, 6)), 1e4 * np.diag(SIGMA**2)])
    posterior = weigh(poses.twist - center, noise, spread, 0.02)
    assert (posterior.share[0] > 0.5).tolist() == found.agreeing.tolist()
    assert np.flatnonzero(~found.agreeing).tolist() == [moved]
    same, covariance = weighted_mean(poses.twist, posterior.information)
    np.testing.assert_allclose(same, center, atol=0.01 * SIGMA.min())
    expected = noise[0] + noise[0] / 4  # of the moved one: its own, and that of four others
    np.testing.assert_allclose(found.covariance[moved], expected, rtol=1e-9)
    np.testing.assert_allclose(covariance, noise[0] / 4, rtol=1e-3, atol=1e-12)
