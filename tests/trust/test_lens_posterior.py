from __future__ import annotations

import math

import numpy as np
import pytest

from calibgraph.model.verdict import FAIL_ABOVE, TOLERANCE, Check
from calibgraph.trust.lens_checks import (
    IMAGES,
    RESIDUALS,
    check_lens,
    probability_of_lens,
)
from calibgraph.trust.lens_posterior import Free, LensParameter, LensPosterior
from calibgraph.trust.thresholds import limit

UNIT = 0.002  # of a calibrated lens
LENS = tuple(Free)[: Free.OFFSET]


def posterior(
    values: dict[Free, float], sigmas: dict[Free, float], moved_cm: float = 30.0
) -> LensPosterior:
    """Of independent parameters; each moves the camera by so much where it is as large as given.

    Args:
        values: of the fit, zero where not given.
        sigmas: of the fit, hardly any where not given.
        moved_cm: by which the pose follows each value, of the others a unit by nothing.
    """
    found, size = np.zeros(len(LENS)), np.full(len(LENS), 1e-4)
    by_unit = np.zeros((6, len(LENS)))
    for number, value in values.items():
        found[number] = value / UNIT
        by_unit[5, number] = moved_cm / 100 / found[number] if value else 0.0
    for number, sigma in sigmas.items():
        size[number] = sigma / UNIT
    shapes = found[-2:], size[-2:] ** 2
    units = np.full(len(LENS), UNIT)
    return LensPosterior(LENS, units, found, np.diag(size**2), np.zeros(6), by_unit, shapes)


def one(
    number: Free, value: float, sigma: float, moved_cm: float = 30.0,
    tolerance: tuple[float, float] = TOLERANCE,
) -> LensParameter:  # fmt: skip
    found = posterior({number: value}, {number: sigma}, moved_cm).parameters(tolerance)
    return found[{Free.FOCAL: 0, Free.RADIAL: 1, Free.ASPECT: 3, Free.SKEW: 4}[number]]


def test_a_parameter_of_which_the_data_say_nothing_raises_no_doubt() -> None:
    assert one(Free.FOCAL, 0.5, 10.0, 500.0).probability == pytest.approx(0.0, abs=1e-3)
    assert one(Free.FOCAL, 0.0, 1e-4, 0.0).probability == 0.0


def test_a_small_change_counts_by_how_far_it_moves_the_camera() -> None:
    near, far = (one(Free.FOCAL, 0.005, 1e-4, moved_cm) for moved_cm in (2.0, 30.0))
    assert near.probability < 1e-6
    assert far.probability > 0.5  # noqa: PLR2004


def test_the_tolerance_of_the_user_decides_how_far_is_wrong() -> None:
    by_tolerance = [
        one(Free.FOCAL, 0.017, 0.002, 9.0, (0.5, cm)).probability for cm in (2.0, 10.0, 30.0)
    ]
    assert by_tolerance[0] > 0.9  # noqa: PLR2004
    assert 0.2 > by_tolerance[1] > by_tolerance[2]


def test_the_probability_grows_with_the_significance() -> None:
    found = [one(Free.RADIAL, 0.03, 0.03 / sigmas).probability for sigmas in (1, 3, 5, 9)]
    assert found == sorted(found) and found[0] < 0.02 and found[-1] > 0.9  # noqa: PLR2004


def test_each_parameter_is_usual_or_wrong_beside_the_other() -> None:
    """Mean and standard deviation as by the sum of the joint density over a grid of both."""
    free, values = (Free.RADIAL, Free.FOCAL), np.array([-5.0, 10.0])
    covariance = np.array([[3.0, -4.0], [-4.0, 14.0]])
    units = np.full(2, UNIT)
    none = np.zeros(0), np.zeros(0)
    found = LensPosterior(free, units, values, covariance, np.zeros(6), np.zeros((6, 2)), none)

    share, usual, wrong = (limit(f"lens_{name}") for name in ("wrong_share", "usual", "wrong"))
    grid = np.linspace(-90, 90, 3601)
    steps = np.stack(np.meshgrid(*(grid - value for value in values), indexing="ij"), axis=-1)
    fits = np.exp(-np.einsum("xyi,ij,xyj->xy", steps, np.linalg.inv(covariance), steps) / 2)
    prior = sum(
        part / spread * np.exp(-((grid / spread) ** 2) / 2)
        for part, spread in ((1 - share, usual), (share, wrong))
    )
    joint = prior[:, None] * prior * fits
    for axis in (0, 1):
        density = joint.sum(axis=1 - axis)
        mean = density @ grid / density.sum()
        sigma = math.sqrt(density @ (grid - mean) ** 2 / density.sum())
        assert found.mean[axis] == pytest.approx(mean, rel=1e-4)
        assert found.sigmas[axis] == pytest.approx(sigma, rel=1e-4)


def test_of_two_parameters_that_explain_the_same_the_likelier_one_is_blamed() -> None:
    """A k1 must be 60 standard deviations off to explain a focal length 5 off."""
    found = posterior({Free.FOCAL: 0.0, Free.RADIAL: 0.12}, {})
    along = np.array([1.0, -12.0, 0.0, 0.0, 0.0, 0.0])
    found = LensPosterior(
        found.free, found.units, found.values, found.covariance + 1e4 * np.outer(along, along),
        found.twist, np.tile(np.eye(6)[:, [5]], (1, 6)) * 0.03, found.shapes,
    )  # fmt: skip
    focal, radial, *_ = found.parameters(TOLERANCE)
    assert found.mean[0] == pytest.approx(5.0, abs=0.9)
    assert focal.probability > 0.6 > 3 * radial.probability  # noqa: PLR2004


def test_a_shape_that_no_lens_has_counts_though_it_hardly_moves_the_camera() -> None:
    assert one(Free.SKEW, 0.03, 0.002, 0.1).probability > 0.9  # noqa: PLR2004
    assert one(Free.ASPECT, 0.03, 0.002, 0.1).probability > 0.9  # noqa: PLR2004
    assert one(Free.FOCAL, 0.03, 0.002, 0.1).probability < 1e-6  # noqa: PLR2004


def test_a_wrong_fy_alone_is_a_wrong_focal_length_too() -> None:
    """Which is not rarer than a wrong aspect ratio alone: both are the estimate."""
    found = posterior({Free.FOCAL: 0.02, Free.ASPECT: 0.04}, {Free.FOCAL: 1e-3, Free.ASPECT: 1e-3})
    focal, _, _, aspect, _ = found.parameters(TOLERANCE)
    assert focal.probability > 0.9 < aspect.probability  # noqa: PLR2004


def test_a_parameter_that_moves_the_camera_beyond_any_length_is_wrong() -> None:
    assert one(Free.FOCAL, 1.0, 1e-3, 1e10).probability > 0.9  # noqa: PLR2004


def test_a_single_frame_leaves_the_significance_unknown() -> None:
    found = posterior({Free.SKEW: 0.03}, {Free.SKEW: math.nan})
    assert not found.is_known and check_lens(found, IMAGES) == []


def check(number: Free, value: float, estimated: tuple[str, ...] = ()) -> Check:
    found = check_lens(
        posterior({number: value}, {number: abs(value) / 8}, 31.2), RESIDUALS, TOLERANCE, estimated
    )
    (wrong,) = (each for each in found if each.status != "PASS")
    return wrong


def test_a_check_states_the_value_its_sigma_the_motion_and_what_to_run() -> None:
    found = check(Free.FOCAL, -0.016)
    assert found.status == "FAIL"
    assert "a focal length 1.60 +- 0.20 % shorter" in found.text
    assert "the camera would move by 0 deg, 31 cm" in found.text
    assert found.text.endswith("or run with --estimate focal")


@pytest.mark.parametrize(
    ("number", "part", "named"),
    [
        (Free.FOCAL, "focal", "intrinsics_sigma_px.focal in the rig"),
        (Free.RADIAL, "distortion", "distortion_sigma in the rig"),
    ],
)
def test_of_what_has_been_estimated_the_prior_that_holds_it_back_is_named(
    number: Free, part: str, named: str
) -> None:
    text = check(number, 0.05, estimated=(part,)).text
    assert "--estimate" not in text
    assert text.endswith(f"it has been estimated, and its prior holds it back: state {named} wider")


def test_the_worst_lens_parameter_counts_and_a_warning_as_one() -> None:
    assert probability_of_lens([]) == 0.0
    found = probability_of_lens([("skew", "PASS", 1e-3), ("lens_skew", "FAIL", 0.7)])
    assert found == 0.7  # noqa: PLR2004
    assert probability_of_lens([("skew", "WARN", 0.7), ("frames", "FAIL", 0.9)]) == FAIL_ABOVE
    assert probability_of_lens([("skew", "PASS", None)]) == 0.0


def test_of_several_parameters_that_look_wrong_all_are_estimated_together() -> None:
    values = {Free.FOCAL: 0.02, Free.RADIAL: 0.04, Free.SKEW: 0.02}
    checks = check_lens(posterior(values, dict.fromkeys(values, 0.002)), IMAGES)
    assert [check.status for check in checks] == ["FAIL", "FAIL", "PASS", "PASS", "FAIL"]
    assert all(c.text.endswith("run with --estimate focal,distortion") for c in checks[:2])
    assert "--estimate" not in checks[4].text
