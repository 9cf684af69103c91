"""Prepared images, and the scores of windows in them."""

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Rig
from calibgraph.matching.structure import frame_cache
from calibgraph.matching.structure.consensus import z_score
from calibgraph.matching.structure.frame_cache import FrameCache
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
from calibgraph.matching.structure.shift_scores import score_frame, subtract_mean_score
from calibgraph.model.rig import Camera
from tests.conftest import SAMPLE


def test_an_image_is_scaled_once_for_each_size(monkeypatch: pytest.MonkeyPatch) -> None:
    data, cache = calibgraph.load_dataset(SAMPLE), FrameCache()
    camera = data.rig.cameras["left"]
    image, other = (cache.image(frame, "left", camera) for frame in data.frames[:2])
    small, scale = image.log_gray(camera, 0.02, 1.0)
    assert small.shape == (round(scale[1] * camera.height_px), round(scale[0] * camera.width_px))
    padded, same = image.padded_log_gray(camera, 0.02, 1.0)
    np.testing.assert_array_equal(padded, pad(small))
    np.testing.assert_array_equal(scale, same)
    assert image.padded_log_gray(camera, 0.02, 1.0)[0] is padded
    assert image.padded_log_gray(camera, 0.01, 1.0)[0].shape > padded.shape
    assert (other.padded_log_gray(camera, 0.02, 1.0)[0] != padded).any()
    np.testing.assert_array_equal(image.mirrored().gray, image.gray[:, ::-1])
    cache.keep_only(data.frames[2:])
    assert not image.smaller.values()
    monkeypatch.setattr(frame_cache, "MAX_SMALL_BYTES", padded.nbytes)
    cache = FrameCache()
    image, other = (cache.image(frame, "left", camera) for frame in data.frames[:2])
    kept = image.padded_log_gray(camera, 0.02, 1.0)[0]
    other.padded_log_gray(camera, 0.02, 1.0)
    assert image.padded_log_gray(camera, 0.02, 1.0)[0] is not kept


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


def test_unrelated_windows_score_no_higher_on_structure_than_on_a_flat_image() -> None:
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.standard_normal((60, 60)), (0, 0), 1.0).astype(np.float32)
    image[:, :30] = image.mean()
    places = np.stack(np.meshgrid(range(-2, 3), range(-2, 3)), axis=-1).reshape(1, 25, 2)
    grids = np.zeros((1, 60, 60), np.float32)
    for angle in rng.uniform(0, 2 * np.pi, 400):  # a silhouette each
        near = np.sign(places[0] @ [np.cos(angle), np.sin(angle)] + rng.uniform(-1, 1))
        basis = np.zeros((1, 25, 4), np.float32)
        basis[0, :, 0] = (near - near.mean()) / np.linalg.norm(near - near.mean())
        score_windows(
            pad(image), places.astype(np.int32), np.array([25], np.int32), basis,
            np.zeros(1, np.int32), np.zeros(2, np.int64), False, grids,
        )  # fmt: skip
    flat, structured = grids[0, 5:55, 5:25].mean() / 400, grids[0, 5:55, 35:55].mean() / 400
    assert abs(structured - flat) < 0.5 * CHANCE_DEPTH


def test_windows_that_tell_nothing_do_not_hold_a_group_in_the_image() -> None:
    """A score that each window has wherever it is in the image is none; what is above it stays."""
    inside = np.random.default_rng(0).integers(0, 20, (3, 9, 13)).astype(np.float32)
    inside[1] = 0  # a group that is never in it
    inside[2] = 20  # and one that never leaves
    grids = 0.3 * inside
    grids[2, 4, 6] += 1
    subtract_mean_score(grids, inside)
    np.testing.assert_allclose(grids[:2], 0, atol=1e-5)
    assert grids[2, 4, 6] - grids[2, 0, 0] == pytest.approx(1)
    np.testing.assert_allclose(grids.mean(axis=(1, 2)), 0, atol=1e-5)


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
