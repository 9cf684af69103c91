"""The consensus of score grids, and the peaks beside it."""

from dataclasses import replace

import numpy as np
import pytest

from calibgraph.matching.structure.consensus import find_consensus
from calibgraph.matching.structure.peaks import find_local_peaks
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.shift_scores import ShiftScores


def make_grids(peaks: np.ndarray) -> np.ndarray:
    """(g, s, s) score grids with one Gaussian peak each, at the shifts (u, v) of (g, 2)."""
    axis = np.arange(-12, 13)
    u, v = np.meshgrid(axis, axis)
    squares = (u - peaks[:, 0, None, None]) ** 2 + (v - peaks[:, 1, None, None]) ** 2
    grids = np.exp(-0.5 * squares / 2.0**2)
    return (grids - grids.mean(axis=(1, 2), keepdims=True)).astype(np.float32)


def make_scores(twist: np.ndarray, *, outlier_share: float) -> ShiftScores:
    """Groups whose peaks a twist explains, and further unknowns, but for a share of outliers."""
    rng = np.random.default_rng(0)
    units = np.append([200, 200, 200, 40, 40, 40], np.full(len(twist) - 6, 4))
    jacobian = rng.uniform(-1, 1, (300, 2, len(twist))) * units
    shifts = jacobian @ twist
    outlier = rng.random(300) < outlier_share
    shifts[outlier] = rng.uniform(-12, 12, (np.count_nonzero(outlier), 2))
    zeros = np.zeros((300, 3))
    return ShiftScores(
        grids=make_grids(shifts),
        jacobian=jacobian,
        points_lidar_m=zeros,
        pixels_px=zeros[:, :2],
        frame=np.zeros(300, np.int64),
        weights=np.full(300, 10.0),
        steps_per_px=np.ones(2),
    )


def test_consensus_finds_the_twist_among_outliers() -> None:
    twist = np.array([0.01, -0.015, 0.008, 0.05, -0.08, 0.06])
    scores = make_scores(twist, outlier_share=0.5)
    found, z_score = find_consensus(scores, LEVELS[0], seed=0)
    off_steps = np.abs(scores.jacobian @ (found - twist)).max()
    assert off_steps < 1.0  # grid step: the groups' own peaks do the rest
    assert z_score > 15


def test_further_unknowns_are_found_with_the_twist() -> None:
    """Also one that a translation beyond the search makes up for: 3 m ahead at 40 steps per m."""
    truth = np.array([0.01, -0.015, 0.008, 0.05, -0.08, 0.06, 1.0, 0.0])
    scores = make_scores(truth, outlier_share=0.5)
    jacobian = scores.jacobian.copy()
    jacobian[:, :, 7] = 60.0 * scores.jacobian[:, :, 3] / 40.0 + 0.02 * scores.jacobian[:, :, 7]
    found, z_score = find_consensus(replace(scores, jacobian=jacobian), LEVELS[0], seed=0)
    assert np.abs(jacobian @ (found - truth)).max() < 1.0
    assert abs(found[6] - 1.0) < 0.1
    assert z_score > 15


def test_consensus_of_outliers_alone_has_a_low_z_score() -> None:
    scores = make_scores(np.zeros(6), outlier_share=1.0)
    _, z_score = find_consensus(scores, LEVELS[0], seed=0)
    assert z_score < 8


def test_peaks_are_found_to_a_fraction_of_a_step() -> None:
    rng = np.random.default_rng(1)
    true = rng.uniform(-6, 6, (50, 2))
    shift, hessian, peak = find_local_peaks(make_grids(true), true + rng.uniform(-1, 1, (50, 2)))
    assert np.isfinite(peak).all()
    np.testing.assert_allclose(shift, true, atol=0.1)
    # The curvature of a Gaussian of sigma 2 at its top, by least squares over +-1 step.
    np.testing.assert_allclose(hessian[:, 0, 0], 0.25, rtol=0.25)
    np.testing.assert_allclose(hessian[:, 0, 1], 0.0, atol=0.02)


def test_an_edge_constrains_only_its_normal() -> None:
    axis = np.arange(-12, 13)
    u, v = np.meshgrid(axis, axis)
    edge = np.exp(-0.5 * (0.6 * u + 0.8 * v - 1.0) ** 2 / 4).astype(np.float32)
    shift, hessian, _ = find_local_peaks(edge[None], np.zeros((1, 2)))
    values, vectors = np.linalg.eigh(hessian[0])
    assert values[0] == pytest.approx(0.0, abs=1e-9)
    assert abs(vectors[:, 1] @ [0.6, 0.8]) == pytest.approx(1.0, abs=1e-3)
    assert shift[0] @ [0.6, 0.8] == pytest.approx(1.0, abs=0.1)


def test_peaks_at_the_rim_are_dropped() -> None:
    _, _, peak = find_local_peaks(make_grids(np.array([[11.0, 0.0]])), np.array([[11.0, 0.0]]))
    assert peak[0] == -np.inf
