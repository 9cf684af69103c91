"""Prepared images, and the scores of windows in them."""

import numpy as np
import pytest

import calibgraph
from calibgraph import Rig
from calibgraph.matching.structure.consensus import z_score
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.prepared_image import PreparedImage
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.score_kernel import (
    CHANCE_DEPTH,
    CHANCE_INTENSITY,
    GRAY_NOISE,
    MIN_RESIDUAL_SHARE,
    OPPOSITE,
    pad,
    score_windows,
)
from calibgraph.matching.structure.shift_scores import score_frame
from calibgraph.model.rig import Camera
from tests.conftest import SAMPLE


def test_images_finer_than_the_finest_level_needs_are_reduced() -> None:
    """By whole pixels, which moves nothing; their logarithm changes by the rounding of gray."""
    camera = calibgraph.load_dataset(SAMPLE).rig.cameras["left"]
    stated, k = camera.model_dump(), camera.intrinsics_px
    stated["intrinsics_px"] = {"fx": 10 * k.fx, "fy": 10 * k.fy, "cx": 2 * k.cx, "cy": 2 * k.cy}
    stated |= {"width_px": 2 * camera.width_px, "height_px": 2 * camera.height_px}
    fine = Camera(**stated)
    rows, columns = np.indices((fine.height_px, fine.width_px))
    gray = (150 + 50 * np.sin(rows / 300) * np.cos(columns / 200)).astype(np.uint8)
    whole, reduced = PreparedImage(gray), PreparedImage.from_gray(gray, fine)
    assert reduced.nbytes * 4 == whole.nbytes
    (one, scale), (other, same) = (
        each.log_gray(fine, LEVELS[-1].step_rad, 1.0) for each in (whole, reduced)
    )
    np.testing.assert_array_equal(scale, same)
    assert np.abs(one - other).max() < 0.5 / gray.min()
    kept = PreparedImage.from_gray(gray[::2, ::2], camera)
    np.testing.assert_array_equal(kept.gray, gray[::2, ::2])


@pytest.mark.parametrize("likelihood", [False, True])
@pytest.mark.parametrize("size", [(1, 1), (9, 13), (13, 17), (6, 33)])
def test_scores_are_those_of_the_formula_wherever_a_window_is_in_the_image(
    likelihood: bool, size: tuple[int, int]
) -> None:
    """Grids as wide as no vector, windows that are partly or never in the image, and groups."""
    rng = np.random.default_rng(0)
    image = rng.standard_normal((20, 30)).astype(np.float32)
    places = rng.integers([-20, -20], [50, 40], (100, 1, 2)) + rng.integers(-3, 4, (100, 12, 2))
    basis = rng.uniform(-0.2, 0.2, (100, 12, 4)).astype(np.float32)
    basis[:, :, 2:] *= not likelihood
    counts = rng.integers(9, 13, 100)
    group = np.repeat([0, 1, 3], [30, 50, 20])
    origin = -np.array(size[::-1]) // 2
    grids, (expected, seen) = np.zeros((4, *size), np.float32), np.zeros((2, 4, *size))
    inside = score_windows(
        pad(image), places.astype(np.int32), counts.astype(np.int32), basis, group.astype(np.int32),
        origin, likelihood, grids,
    )  # fmt: skip
    for window, n, columns, g in zip(places, counts, basis, group, strict=True):
        for row, column in np.ndindex(size):
            u, v = (window[:n] + origin + [column, row]).T
            if min(u.min(), v.min()) >= 0 and u.max() < 30 and v.max() < 20:
                score = formula(image[v, u] - image.mean(), columns[:n], likelihood)
                expected[g, row, column] += score
                seen[g, row, column] += 1
    rounding = 50 * 12 * np.finfo(np.float32).eps  # of the windows of a group, and their points
    assert np.count_nonzero(expected) > 0.5 * expected[[0, 1, 3]].size
    np.testing.assert_allclose(grids, expected, rtol=rounding, atol=rounding)
    np.testing.assert_array_equal(inside, seen if likelihood else seen[:0])


def formula(seen: np.ndarray, basis: np.ndarray, likelihood: bool) -> float:
    """The score of a window at one shift."""
    depth, intensity, *trend = basis.T.astype(np.float64) @ seen
    noise = len(seen) * GRAY_NOISE**2
    variance = len(seen) * seen.astype(np.float64).var() - np.square(trend).sum() + noise
    explained = depth**2 + (1 if intensity > 0 else OPPOSITE) * intensity**2
    chance = [CHANCE_DEPTH, CHANCE_INTENSITY] @ np.square(basis[:, :2].astype(np.float64)).sum(0)
    share = explained / variance - chance * (1 - noise / variance)
    return float(-np.log(1 - share / (1 + MIN_RESIDUAL_SHARE)) if likelihood else share)


def test_scores_of_a_frame_agree_at_the_true_pose(truth: Rig) -> None:
    frame = calibgraph.load_dataset(SAMPLE).frames[0]
    camera = truth.cameras["front_left"]
    gray, cloud = (
        PreparedImage(frame.load_gray("front_left", camera)),
        PreparedCloud.from_points(frame.load_cloud()),
    )
    scores = score_frame(gray, cloud, camera, LEVELS[1], frame=7, max_windows=2_000)
    assert set(scores.frame) == {7} and 0 < scores.weights.sum() <= 2_000
    np.testing.assert_allclose(scores.grids.mean(axis=(1, 2)), 0, atol=1e-4)
    assert z_score(scores, np.zeros(6)) > 5 * abs(z_score(scores, np.repeat([0.02, 0.0], 3)))
