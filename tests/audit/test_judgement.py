import numpy as np
import pytest

from calibgraph.arrays import Array
from calibgraph.audit.judgement import (
    FALSE_ALARM_RATE,
    Limits,
    detectable,
    judge_deviation,
    tolerance_twist,
)

TOLERANCE = tolerance_twist(0.5, 10.0)
SIGMA = np.repeat([np.radians(0.09), 0.02], 3)
KNOWN = Limits.of(np.inf, FALSE_ALARM_RATE / 3, TOLERANCE)


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
    found, reason = judge_deviation(xi, np.diag(bar**2), KNOWN)
    assert found == status and words in reason
    if status == "WRONG":
        assert reason.count("turned about") == np.count_nonzero(xi[:3])


def alarms(limits: Limits, sigma: Array, rng: np.random.Generator) -> int:
    """How many of the rigs with these estimated (n, 6) sigmas, which are 1, seem to have moved."""
    draws, covariance = rng.standard_normal(sigma.shape), sigma[..., None] ** 2 * np.eye(6)
    return int(np.count_nonzero(limits.significant(draws, covariance).any(axis=1)))


def test_at_most_one_of_a_thousand_unchanged_rigs_seems_to_have_moved() -> None:
    limits = Limits.of(np.inf, FALSE_ALARM_RATE, TOLERANCE)
    found = alarms(limits, np.ones((200_000, 6)), np.random.default_rng(0))
    assert 100 < found < 200 + 4 * np.sqrt(200)  # Poisson; half are of an axis, half of a whole


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_at_most_one_does_if_sigma_is_of_few_frames(share: float) -> None:
    """10 degrees of freedom of a part, beside a part that is known."""
    rng, rigs, freedom = np.random.default_rng(0), 50_000, 10
    estimated = np.repeat(share * rng.chisquare(freedom, (rigs, 2)) / freedom, 3, axis=1)
    variance = estimated + 1 - share
    limits = Limits.of(freedom, FALSE_ALARM_RATE, TOLERANCE, estimated=estimated / variance)
    assert alarms(limits, np.sqrt(variance), rng) < 50 + 4 * np.sqrt(50)  # Poisson
    if share >= 0.5:  # by the normal distribution they would be too many
        normal = Limits.of(np.inf, FALSE_ALARM_RATE, TOLERANCE)
        assert alarms(normal, np.sqrt(variance), rng) > 100


@pytest.mark.parametrize("turned", [True, False])
def test_a_motion_between_the_axes_is_significant_as_a_whole(turned: bool) -> None:
    xi = np.roll([3.0, 3.0, 3.0, 0, 0, 0], 0 if turned else 3)  # sigmas: less than along an axis
    assert KNOWN.axis.min() > 3.0
    for covariance in (np.eye(6), np.array([np.eye(6)] * 2)):
        found = KNOWN.significant(np.broadcast_to(xi, covariance.shape[:-1]), covariance)
        np.testing.assert_array_equal(found, np.broadcast_to(xi != 0, found.shape))


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_tolerance_must_be_positive_and_finite(value: float) -> None:
    with pytest.raises(ValueError, match="tolerance_cm must be positive"):
        tolerance_twist(0.5, value)


@pytest.mark.parametrize("times", [0.3, 0.9, 0.99, 1.01, 1.1, 3.0])
def test_ok_never_stands_beside_a_detectable_change_above_the_tolerance(times: float) -> None:
    """Not even where the deviation itself is zero."""
    largest = np.repeat(TOLERANCE, 3) / detectable(np.ones(6), KNOWN.confident)
    covariance = np.diag((times * largest) ** 2)
    status, reason = judge_deviation(np.zeros(6), covariance, KNOWN)
    assert (status == "OK") == (times < 1)
    if times > 1:  # the tolerance that is enough, or more frames
        assert f"tolerate {times * 0.5:.2g} deg and {times * 10:.2g} cm, or record" in reason
