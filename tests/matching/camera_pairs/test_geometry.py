"""Epipolar geometry on rays: found for any lens, and none of what agrees by chance."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Camera, Intrinsics
from calibgraph.matching.camera_pairs.geometry import (
    MAX_LOG10_FALSE_ALARMS,
    agree_on_epipolar_geometry,
    log10_false_alarms,
)
from calibgraph.simulation.rigs import rig_of
from factors import unproject

NARROW = Camera(
    width_px=1241,
    height_px=376,
    intrinsics_px=Intrinsics(fx=718.9, fy=718.9, cx=607.2, cy=185.2),
    T_camera_lidar=np.eye(4),
)
FISHEYES = tuple(rig_of("fisheye").cameras[name] for name in ("front", "left"))


def seen_by_both(
    cameras: tuple[Camera, Camera], T_b_a: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of the same points, with 0.3 px noise, where both images have them."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-30, -4, -30], [30, 4, 30], (100 * count, 3))
    sides = []
    for camera, T in zip(cameras, (np.eye(4), T_b_a), strict=True):
        pixels, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
        pixels += 0.3 * rng.standard_normal(pixels.shape)
        rays, found = unproject(camera.lens, pixels)
        sides.append((rays, valid & found & camera.in_image(pixels)))
    both = np.flatnonzero(sides[0][1] & sides[1][1])[:count]
    assert len(both) == count
    return sides[0][0][both], sides[1][0][both]


def random_rays(camera: Camera, count: int, rng: np.random.Generator) -> np.ndarray:
    size = camera.width_px, camera.height_px
    rays, valid = unproject(camera.lens, rng.uniform(0, size, (4 * count, 2)))
    return rays[valid][:count]


def pose_between(a: Camera, b: Camera) -> np.ndarray:
    return b.T_camera_lidar @ np.linalg.inv(a.T_camera_lidar)


SIDEWAYS = np.eye(4)
SIDEWAYS[0, 3] = -0.54


@pytest.mark.parametrize(
    ("cameras", "T_b_a"),
    [((NARROW, NARROW), SIDEWAYS), (FISHEYES, pose_between(*FISHEYES))],
    ids=["narrow", "fisheyes a right angle apart"],
)
def test_true_matches_are_kept_and_false_ones_dropped(
    cameras: tuple[Camera, Camera], T_b_a: np.ndarray
) -> None:
    true, false, rng = 200, 150, np.random.default_rng(3)
    rays = [
        np.concatenate([right, random_rays(camera, false, rng)])
        for right, camera in zip(seen_by_both(cameras, T_b_a, true, 1), cameras, strict=True)
    ]
    fit = agree_on_epipolar_geometry(*cameras, *rays, seed=0)
    assert fit.log10_false_alarms < -100
    assert fit.inlier[:true].mean() > 0.95
    assert fit.inlier[true:].mean() < 0.05


@pytest.mark.parametrize("count", [0, 3, 6, 40, 300])
@pytest.mark.parametrize("cameras", [(NARROW, NARROW), FISHEYES], ids=["narrow", "fisheye"])
def test_random_matches_agree_on_nothing(cameras: tuple[Camera, Camera], count: int) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        rays = [random_rays(camera, count, rng) for camera in cameras]
        fit = agree_on_epipolar_geometry(*cameras, *rays, seed=seed)
        assert not fit.inlier.any()
        assert len(fit.inlier) == count


def test_the_number_of_false_alarms_is_an_upper_bound() -> None:
    """Of residuals that are uniform over the image height, none of 2000 draws is accepted."""
    rng = np.random.default_rng(0)
    alarms = [
        log10_false_alarms(rng.uniform(0, 376, 100), (NARROW, NARROW))[0] for _ in range(2000)
    ]
    assert min(alarms) > MAX_LOG10_FALSE_ALARMS
