from __future__ import annotations

import numpy as np
import pytest

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


def deviation(axis: int, value: float) -> np.ndarray:
    """A deviation in degrees or centimetres about or along one axis."""
    twist = np.zeros(6)
    twist[axis] = np.radians(value) if axis < 3 else value / 100
    return twist


def test_a_significant_deviation_beyond_the_tolerance_is_wrong_and_its_axis_is_named() -> None:
    status, reason = judge_deviation(deviation(1, -0.8), COVARIANCE, KNOWN, TOLERANCE)
    assert status == "WRONG"
    assert reason == "turned about y (yaw) by -0.80 deg (sigma 0.09)"
    status, reason = judge_deviation(deviation(5, 15.0), COVARIANCE, KNOWN, TOLERANCE)
    assert status == "WRONG"
    assert "moved along z (ahead) by +15.00 cm" in reason


def test_a_significant_deviation_within_the_tolerance_is_ok_and_named() -> None:
    sharp = COVARIANCE / 16
    status, reason = judge_deviation(deviation(0, 0.3), sharp, KNOWN, TOLERANCE)
    assert status == "OK"
    assert "within the tolerance, though significant" in reason
    assert "x (pitch) by +0.30 deg" in reason


def test_a_deviation_near_the_tolerance_cannot_be_told() -> None:
    status, reason = judge_deviation(deviation(2, 0.45), COVARIANCE, KNOWN, TOLERANCE)
    assert status == "CANNOT TELL"
    assert "check another recording" in reason


@pytest.mark.parametrize(
    ("turns_deg", "status"),
    [
        ((0.4, 0.4, 0.4), "WRONG"),  # 0.70 deg in all, each within 0.5 deg
        ((0.4, -0.4, 0.0), "WRONG"),
        ((0.15, 0.15, 0.15), "OK"),  # 0.26 deg
        ((0.27, 0.27, 0.27), "CANNOT TELL"),  # 0.47 deg
    ],
)
def test_the_tolerance_is_of_the_whole_turn(
    turns_deg: tuple[float, float, float], status: str
) -> None:
    twist = np.array([*np.radians(turns_deg), 0.0, 0.0, 0.0])
    covariance = np.diag(np.repeat([np.radians(0.05), 0.01], 3) ** 2)
    found, reason = judge_deviation(twist, covariance, KNOWN, TOLERANCE)
    assert found == status
    if status == "WRONG":
        assert reason.count("turned about") == np.count_nonzero(turns_deg)


def test_axes_that_are_not_significant_do_not_make_a_turn_too_large() -> None:
    sigma = np.repeat([np.radians(0.02), 0.01], 3)
    sigma[1] = np.radians(0.3)
    twist = np.array([*np.radians((0.1, 0.6, 0.0)), 0.0, 0.0, 0.0])
    assert judge_deviation(twist, np.diag(sigma**2), KNOWN, TOLERANCE)[0] == "CANNOT TELL"


@pytest.mark.parametrize(("axis", "words"), [(1, "all over the image"), (5, "within 10 m")])
def test_no_deviation_with_a_wide_error_bar_cannot_be_told(axis: int, words: str) -> None:
    wide = SIGMA.copy()
    wide[axis] *= 10
    status, reason = judge_deviation(np.zeros(6), np.diag(wide**2), KNOWN, TOLERANCE)
    assert status == "CANNOT TELL"
    assert words in reason


def test_a_large_deviation_that_is_not_significant_is_not_called_wrong() -> None:
    wide = 100 * COVARIANCE
    assert judge_deviation(deviation(0, 2.0), wide, KNOWN, TOLERANCE)[0] == "CANNOT TELL"


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
