"""The robust spread of residuals."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.solver.residual_scale import (
    iterate_spread,
    quantile,
    quantiles,
    robust_spread,
    robust_spreads,
)


def test_the_spread_of_a_core_is_found_under_a_broad_background() -> None:
    rng = np.random.default_rng(0)
    for inliers in (1.0, 0.6, 0.3):
        core = np.hypot(*rng.standard_normal((2, 4000))) / 1.17741
        values = np.concatenate([core, rng.uniform(0, 300, round(4000 * (1 / inliers - 1)))])
        assert robust_spread(values) == pytest.approx(1.0, rel=0.05)
    # Values without a core have the spread of all of them.
    assert robust_spread(rng.uniform(0, 300, 4000)) == pytest.approx(150, rel=0.05)
    assert robust_spread(np.zeros(10)) == 0.0


def sorted_spread(values: np.ndarray) -> float:
    """By its definition, on sorted values."""
    ordered = np.sort(values)

    def quantile_below(limit: float, share: float) -> float:
        below = ordered[ordered <= limit]
        return float(np.quantile(below, share)) if len(below) else np.nan

    return iterate_spread(quantile_below)


@pytest.mark.parametrize("count", [1, 2, 30, 700, 3000, 20_000])
def test_the_spread_is_that_of_sorted_values(count: int) -> None:
    """Whatever their size, with equal ones among them, and far outliers."""
    rng = np.random.default_rng(count)
    for unit in (1e-7, 1e-2, 1.0, 1e6):
        values = unit * np.abs(rng.standard_normal(count))
        values[: count // 3] = values[-1]
        values[count // 2 :: 7] *= 1e4
        # Interpolation between two values is rounded in another order.
        assert robust_spread(values) == pytest.approx(sorted_spread(values), rel=1e-12)


def test_runs_have_the_spread_of_their_finite_values() -> None:
    values = np.abs(np.random.default_rng(1).standard_normal(1000))
    values[100:110] = np.inf
    runs = np.array([[0, 400], [400, 1000], [100, 110]])
    found = robust_spreads(values, runs)
    finite = values[:400][np.isfinite(values[:400])]
    assert found.tolist() == [robust_spread(finite), robust_spread(values[400:]), np.inf]


@pytest.mark.parametrize("count", [1, 2, 30, 3000, 20_000])
def test_quantiles_are_those_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).exponential(5.0, count)
    for share in (0.0, 0.02, 0.5, 0.98, 1.0):
        # Interpolation between two values is rounded in another order.
        assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-14)
    runs = np.array([[0, count], [count // 2, count]])
    expected = [np.median(values[slice(*run)]) for run in runs]
    np.testing.assert_allclose(quantiles(values, runs, 0.5), expected, rtol=1e-14)
