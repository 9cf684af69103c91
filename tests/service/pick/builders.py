"""Pairs of a rig with a known truth."""

from __future__ import annotations

import numpy as np

from calibgraph import Rig
from calibgraph.service.pick.session import Pair


def draw_pairs(
    rig: Rig,
    camera: str,
    count: int,
    rng: np.random.Generator,
    *,
    noise_px: float = 0.0,
    aside: tuple[float, float] = (-0.7, 0.7),
) -> list[Pair]:
    """Pairs of points in view, at 4 to 30 m, the pixels with noise; two frames in turn.

    Args:
        aside: range of y / x of the points.
    """
    seen, T, found = rig.cameras[camera], rig.T_camera_lidar[camera], []
    while len(found) < count:
        ahead = np.exp(rng.uniform(np.log(4), np.log(30)))
        point = ahead * np.array([1.0, rng.uniform(*aside), rng.uniform(-0.25, 0.15)])
        pixels, valid = seen.lens.project((T[:3, :3] @ point + T[:3, 3])[None])
        if not valid[0] or not seen.in_image(pixels)[0]:
            continue
        pixel = pixels[0] + noise_px * rng.standard_normal(2)
        found.append(pair_of(camera, pixel, point, frame=len(found) % 2))
    return found


def pair_of(camera: str, pixel: np.ndarray, point: np.ndarray, frame: int = 0) -> Pair:
    return Pair(
        frame=frame,
        camera=camera,
        pixel_px=(float(pixel[0]), float(pixel[1])),
        point_index=0,
        point_lidar_m=(float(point[0]), float(point[1]), float(point[2])),
    )


def project(rig: Rig, camera: str, points: np.ndarray) -> np.ndarray:
    """(n, 2) pixels of (n, 3) points in the LiDAR frame."""
    T = rig.T_camera_lidar[camera]
    return rig.cameras[camera].lens.project(points @ T[:3, :3].T + T[:3, 3])[0]
