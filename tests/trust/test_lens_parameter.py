from __future__ import annotations

import math

import numpy as np
import pytest

from calibgraph.solver.columns import Marginal
from calibgraph.trust.lens_parameter import (
    IMAGES,
    RESIDUALS,
    LensParameter,
    advise_together,
    check_parameter,
)
from calibgraph.trust.thresholds import LENS_WRONG, LENS_WRONG_SHARE


def estimate(name: str, size: float, sigma: float, moved_cm: float) -> LensParameter:
    unit = np.array([0.002])  # of a calibrated lens
    twist = np.array([0, 0, 0, 0, 0, moved_cm / 100])
    return LensParameter(name, np.array([size]) / unit, np.array([sigma]) / unit, twist, unit)


def test_a_parameter_of_which_the_residuals_say_nothing_raises_no_doubt() -> None:
    assert estimate("focal length", 0.5, 1.0, 500.0).probability() == pytest.approx(0.0, abs=1e-3)
    assert estimate("focal length", 0.0, 1e-4, 0.0).probability() == 0.0
    for sigma in (math.nan, math.inf, 1e100):
        found = estimate("focal length", 0.01, sigma, 50.0)
        assert found.probability() == pytest.approx(0.0, abs=1e-12)


def test_the_tolerance_of_the_user_decides_how_far_is_wrong() -> None:
    found = estimate("focal length", 0.017, 0.002, 8.0)
    by_tolerance = [found.probability((0.5, cm)) for cm in (2.0, 10.0, 30.0)]
    assert by_tolerance[0] > 0.9  # noqa: PLR2004
    assert 0.2 > by_tolerance[1] > by_tolerance[2]
    assert found.probability() == by_tolerance[1]
    assert check_parameter(found, IMAGES, (0.5, 2.0)).value == by_tolerance[0]


def freed(*values: float, covariance: list[list[float]]) -> Marginal:
    compensating = np.ones((6, len(values)))
    return Marginal(np.zeros(6), np.array(values), np.array(covariance), compensating)


@pytest.mark.parametrize("other", [0.0, -2.0, -5.0, 8.0, 30.0])
def test_the_other_parameter_is_usual_or_wrong(other: float) -> None:
    """As by the sum of the joint density over a grid of both."""
    covariance = np.array([[3.0, -4.0], [-4.0, 14.0]])
    fit = freed(other, 10.0, covariance=covariance.tolist())
    found = LensParameter.of("distortion", [0.002], fit)

    share, wrong, grid = LENS_WRONG_SHARE, LENS_WRONG, np.linspace(-90, 90, 1801)
    steps = np.stack(np.meshgrid(grid - other, grid - 10.0, indexing="ij"), axis=-1)
    fits = np.exp(-np.einsum("xyi,ij,xyj->xy", steps, np.linalg.inv(covariance), steps) / 2)
    prior = (1 - share) * np.exp(-(grid**2) / 2)
    prior += share / wrong * np.exp(-((grid / wrong) ** 2) / 2)
    density = (prior[:, None] * fits).sum(axis=0)
    mean = density @ grid / density.sum()
    sigma = math.sqrt(density @ (grid - mean) ** 2 / density.sum())
    np.testing.assert_allclose([found.values[0], found.sigmas[0]], [mean, sigma], rtol=1e-6)


def test_a_shape_that_no_lens_has_counts_though_it_hardly_moves_the_camera() -> None:
    assert estimate("aspect ratio", 0.03, 0.002, 0.1).probability() > 0.9  # noqa: PLR2004
    assert estimate("focal length", 0.03, 0.002, 0.1).probability() < 1e-6  # noqa: PLR2004


def test_of_several_parameters_that_look_wrong_all_are_estimated_together() -> None:
    focal = check_parameter(estimate("focal length", 0.02, 0.002, 30.0), IMAGES)
    centre = check_parameter(estimate("principal point", 0.02, 0.002, 30.0), RESIDUALS)
    aspect = check_parameter(estimate("aspect ratio", 0.02, 0.002, 30.0), IMAGES)
    right = check_parameter(estimate("distortion", 0.0, 0.002, 0.0), IMAGES)
    assert focal.text.endswith("run with --estimate focal")
    assert advise_together([focal, right]) == [focal, right]
    texts = [check.text for check in advise_together([focal, right, centre])]
    assert [text.rpartition(" ")[2] for text in (texts[0], texts[2])] == ["lens", "lens"]
    assert texts[1] == right.text
    of_shape = advise_together([focal, aspect])
    assert of_shape == [focal, aspect] and "--estimate" not in aspect.text
