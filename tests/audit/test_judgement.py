from __future__ import annotations

import numpy as np
import pytest

from calibgraph.arrays import Array
from calibgraph.audit.judgement import (
    POWER,
    detectable,
    judge_deviation,
    quantiles_in_part,
    student_quantiles,
    tail_of_axis,
    tolerance_twist,
)

TOLERANCE = tolerance_twist(0.5, 10.0)
SIGMA = np.repeat([np.radians(0.09), 0.02], 3)
COVARIANCE = np.diag(SIGMA**2)
KNOWN = student_quantiles(np.inf, tail_of_axis(3))
QUANTILE = KNOWN[0, 0]


def twist(turns_deg: tuple[float, float, float], shifts_cm: tuple[float, ...] = (0, 0, 0)) -> Array:
    return np.array([*np.radians(turns_deg), *np.divide(shifts_cm, 100)])


def sigma(turn_deg: float, shift_cm: float = 1.0, **of_axis: float) -> Array:
    """Of all axes; of some of them, numbered, another [rad, m]."""
    found = np.repeat([np.radians(turn_deg), shift_cm / 100], 3)
    for axis, value in of_axis.items():
        found[int(axis[-1])] = value
    return found


NONE = (0.0, 0.0, 0.0)
JUDGED = {
    "beyond the tolerance": (
        twist((0, -0.8, 0)), SIGMA, "WRONG", "turned about y (yaw) by -0.80 deg (sigma 0.09)"),
    "a shift beyond it": (
        twist(NONE, (0, 0, 15)), SIGMA, "WRONG", "moved along z (ahead) by +15.00 cm"),
    "within it": (
        twist((0.3, 0, 0)), SIGMA / 4, "OK",
        "within the tolerance, though significant: turned about x (pitch) by +0.30 deg"),
    "near it": (twist((0, 0, 0.45)), SIGMA, "CANNOT TELL", "check another recording"),
    "0.70 deg in all": (twist((0.4, 0.4, 0.4)), sigma(0.05), "WRONG", "z (roll) by +0.40"),
    "of two axes": (twist((0.4, -0.4, 0)), sigma(0.05), "WRONG", "y (yaw) by -0.40"),
    "0.26 deg in all": (twist((0.15, 0.15, 0.15)), sigma(0.05), "OK", ""),
    "0.47 deg in all": (twist((0.27, 0.27, 0.27)), sigma(0.05), "CANNOT TELL", ""),
    "too large, but open": (
        twist((0.1, 0.6, 0)), sigma(0.02, axis1=np.radians(0.3)), "CANNOT TELL", ""),
    "none, with a wide turn": (
        twist(NONE), sigma(0.09, 2, axis1=np.radians(0.9)), "CANNOT TELL", "all over the image"),
    "none, with a wide shift": (
        twist(NONE), sigma(0.09, 2, axis5=0.2), "CANNOT TELL", "within 10 m"),
    "large, not significant": (twist((2.0, 0, 0)), 10 * SIGMA, "CANNOT TELL", ""),
}  # fmt: skip


@pytest.mark.parametrize("name", JUDGED)
def test_a_deviation_is_judged_by_the_whole_turn_and_shift_and_its_axes_are_named(
    name: str,
) -> None:
    xi, bar, status, words = JUDGED[name]
    found, reason = judge_deviation(xi, np.diag(bar**2), KNOWN, TOLERANCE)
    assert found == status and words in reason
    if status == "WRONG":
        assert reason.count("turned about") == np.count_nonzero(xi[:3])


def test_one_of_a_thousand_unchanged_rigs_has_a_significant_axis() -> None:
    draws = np.random.default_rng(0).standard_normal((400_000, 6 * 3))
    alarms = np.count_nonzero((np.abs(draws) > QUANTILE).any(axis=1))
    assert abs(alarms - 400) < 4 * np.sqrt(400)  # a Poisson count


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_at_most_one_of_a_thousand_has_one_if_sigma_is_of_few_frames(share: float) -> None:
    """10 degrees of freedom of a part, beside a part that is known."""
    rng, rigs, freedom = np.random.default_rng(0), 50_000, 10
    estimated = share * rng.chisquare(freedom, (rigs, 6)) / freedom
    variance = estimated + 1 - share
    known, own = (student_quantiles(nu, tail_of_axis(1)) for nu in (np.inf, freedom))
    shares = (estimated / variance)[:, None]
    limit = quantiles_in_part(shares, own, known)[:, 0] * np.sqrt(variance)
    draws = np.abs(rng.standard_normal(variance.shape))
    assert np.count_nonzero((draws > limit).any(axis=1)) < 50 + 4 * np.sqrt(50)  # Poisson
    if share >= 0.5:  # by the normal distribution they would be too many
        by_normal = draws > known[0] * np.sqrt(variance)
        assert np.count_nonzero(by_normal.any(axis=1)) > 100


def test_the_smallest_detectable_change_is_significant_with_the_stated_power() -> None:
    sizes = detectable(np.ones(6), QUANTILE)
    draws = sizes[0] + np.random.default_rng(1).standard_normal(100_000)
    found = np.mean(np.abs(draws) > QUANTILE)
    assert abs(found - POWER) < 4 * np.sqrt(POWER * (1 - POWER) / 100_000)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_tolerance_must_be_positive_and_finite(value: float) -> None:
    with pytest.raises(ValueError, match="tolerance_cm must be positive"):
        tolerance_twist(0.5, value)


@pytest.mark.parametrize("times", [0.3, 0.9, 0.99, 1.01, 1.1, 3.0])
def test_ok_never_stands_beside_a_detectable_change_above_the_tolerance(times: float) -> None:
    """Not even where the deviation itself is zero."""
    largest = np.repeat(TOLERANCE, 3) / detectable(np.ones(6), KNOWN[1])
    covariance = np.diag((times * largest) ** 2)
    status, reason = judge_deviation(np.zeros(6), covariance, KNOWN, TOLERANCE)
    assert (status == "OK") == (times < 1)
    if times > 1:  # the tolerance that is enough, or more frames
        assert f"tolerate {times * 0.5:.2g} deg and {times * 10:.2g} cm, or record" in reason
