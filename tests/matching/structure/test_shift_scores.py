from __future__ import annotations

import numpy as np
import pytest

import calibgraph
from calibgraph import Rig
from calibgraph.matching.structure.consensus import z_score
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.score_kernel import (
    GRAY_NOISE,
    MIN_RESIDUAL_SHARE,
    score_windows,
)
from calibgraph.matching.structure.shift_scores import score_frame
from tests.conftest import SAMPLE


def orthonormal(points: int, columns: int, rng: np.random.Generator) -> np.ndarray:
    """(points, columns), orthogonal to constants too."""
    draws = np.column_stack([np.ones(points), rng.standard_normal((points, columns))])
    return np.linalg.qr(draws)[0][:, 1:]


@pytest.mark.parametrize("likelihood", [False, True])
def test_the_score_of_a_window_is_its_share_of_the_images_variance(likelihood: bool) -> None:
    rng = np.random.default_rng(0)
    image = rng.standard_normal((20, 30)).astype(np.float32)
    places = rng.integers([10, 8], [18, 14], (12, 2)).astype(np.int32)
    basis = orthonormal(12, 4, rng).astype(np.float32)
    basis[:, 2:] *= not likelihood
    grids = np.zeros((1, 5, 5), np.float32)
    score_windows(
        image, places[None], np.array([12], np.int32), basis[None], np.zeros(1, np.int32),
        np.array([-2, -2]), likelihood, grids,
    )  # fmt: skip
    seen = image[places[:, 1] - 1, places[:, 0] + 2]  # at the shift (2, -1)
    depth, intensity, *trend = basis.T @ seen
    variance = 12 * seen.var() - np.square(trend).sum() + 12 * GRAY_NOISE**2
    share = (depth**2 + intensity * abs(intensity)) / variance
    largest = 1 + MIN_RESIDUAL_SHARE
    log = np.sign(share) * np.log(largest / (largest - abs(share)))
    assert grids[0, 1, 4] == pytest.approx(log if likelihood else share, rel=1e-4)


def test_shifts_at_which_a_window_leaves_the_image_score_zero() -> None:
    rng = np.random.default_rng(0)
    image = rng.standard_normal((20, 30)).astype(np.float32)
    places = rng.integers([1, 1], [6, 6], (12, 2)).astype(np.int32)  # next to the first corner
    basis = orthonormal(12, 4, rng).astype(np.float32)
    grids = np.zeros((1, 5, 5), np.float32)
    score_windows(
        image, places[None], np.array([12], np.int32), basis[None], np.zeros(1, np.int32),
        np.array([-2, -2]), False, grids,
    )  # fmt: skip
    outside = -places.min(axis=0)  # the first shift inside, (u, v)
    assert not grids[0, : outside[1] + 2].any() and not grids[0, :, : outside[0] + 2].any()
    assert grids[0, outside[1] + 2 :, outside[0] + 2 :].all()


def test_scores_of_a_frame_agree_at_the_true_pose(truth: Rig) -> None:
    frame = calibgraph.load_dataset(SAMPLE).frames[0]
    camera = truth.cameras["front_left"]
    gray, cloud = (
        frame.load_gray("front_left", camera),
        PreparedCloud.from_points(frame.load_cloud()),
    )
    scores = score_frame(gray, cloud, camera, LEVELS[1], frame=7, max_windows=2_000)
    assert set(scores.frame) == {7} and scores.counts.sum() <= 2_000
    np.testing.assert_allclose(scores.grids.mean(axis=(1, 2)), 0, atol=1e-4)
    assert z_score(scores, np.zeros(6)) > 5 * abs(z_score(scores, np.repeat([0.02, 0.0], 3)))
