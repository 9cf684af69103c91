"""Lenses that are not quite as the rig files state them."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Camera
from calibgraph.simulation.cameras import pixel_directions
from calibgraph.simulation.rigs import RIG_NAMES, rig_of
from tools.scenes.lens_errors import draw_lens_errors


def missed_px(stated: Camera, camera: Camera, T_camera_lidar: np.ndarray) -> float:
    """Root mean square, over the middle of the image and 5 to 40 m, of where points are seen."""
    sides = (np.linspace(0.1 * n, 0.9 * n, 9) for n in (camera.width_px, camera.height_px))
    pixels_px = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    rays = pixel_directions(camera, pixels_px)
    seen = rays.any(axis=1)
    errors = []
    for depth in (5.0, 10.0, 20.0, 40.0):
        points = depth * rays[seen]
        T = T_camera_lidar @ np.linalg.inv(camera.T_camera_lidar)
        there, _ = stated.lens.project(points @ T[:3, :3].T + T[:3, 3])
        errors.append(np.linalg.norm(there - pixels_px[seen], axis=1))
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("name", [name for name in RIG_NAMES if name != "panorama"])
def test_the_stated_pose_goes_best_with_the_stated_lens(name: str) -> None:
    rig = rig_of(name)
    stated = draw_lens_errors(rig, 1.0, np.random.default_rng(3))
    for key, camera in rig.cameras.items():
        one = stated.cameras[key]
        assert one.intrinsics_px != camera.intrinsics_px
        own = missed_px(one, camera, one.T_camera_lidar)
        assert own < 0.7 * missed_px(one, camera, camera.T_camera_lidar)
        assert own < 5e-4 * camera.width_px


def test_the_size_scales_them_and_none_changes_nothing() -> None:
    rig = rig_of("walkley")
    assert draw_lens_errors(rig, 0.0, np.random.default_rng(0)) == rig
    for size in (1.0, 2.0):
        rng = np.random.default_rng(1)
        cameras = [c for _ in range(12) for c in draw_lens_errors(rig, size, rng).cameras.values()]
        true = rig.cameras["primary"].intrinsics_px
        focal = np.std([c.intrinsics_px.fx / true.fx for c in cameras])
        centre = np.std([c.intrinsics_px.cy for c in cameras])
        assert focal == pytest.approx(1e-3 * size, rel=0.4)
        assert centre == pytest.approx(5e-4 * 1920 * size, rel=0.4)
    panorama = rig_of("panorama")
    assert draw_lens_errors(panorama, 1.0, np.random.default_rng(0)) == panorama
