"""Random LiDAR points that a camera sees: at random depths, or on a street."""

import math

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera
from calibgraph.solver.pnp import normalized
from factors import unproject

Rng = np.random.Generator

_MAX_TRIES = 1000
_LIDAR_HEIGHT_M, _FAR_M = 1.73, 80.0
_WALLS_M = (7.0, 12.0)
_BEAMS_RAD = (math.radians(-25.0), math.radians(15.0))
_CLUTTER = 0.4  # share of the rays that end before the walls and the road


def draw_visible_points(
    rng: Rng, camera: Camera, count: int, depth_m: tuple[float, float] | None
) -> Array:
    """Draw points that project into the image, by rejection.

    Args:
        rng: of all draws.
        camera: its lens and T_camera_lidar.
        count: of the points.
        depth_m: range of depths, or None for a street; see :func:`simulate_correspondences`.

    Returns:
        (count, 3) in the camera frame [m].

    Raises:
        ValueError: if the camera sees too few of them.
    """
    kept = np.empty((0, 3))
    for _ in range(_MAX_TRIES):
        if depth_m is None:
            points = _draw_on_street(rng, camera, 2 * count)
        else:
            points = _draw_scattered(rng, camera, 2 * count, depth_m)
        pixels, valid = camera.lens.project(points)
        kept = np.vstack([kept, points[valid & camera.in_image(pixels)]])
        if len(kept) >= count:
            return kept[:count]
    where = "of a street" if depth_m is None else f"between {depth_m} m"
    raise ValueError(f"no {count} points {where} project into the image")


def _draw_scattered(rng: Rng, camera: Camera, count: int, depth_m: tuple[float, float]) -> Array:
    """(count, 3) points in the camera frame, in about the directions of the image."""
    low, high = np.log(depth_m)
    if camera.model in ("omnidirectional", "equirectangular"):
        rays = _draw_rays(rng, camera, count)
        return np.asarray(rays * np.exp(rng.uniform(low, high, (len(rays), 1))))
    spread = 1.2 * np.array([camera.width_px, camera.height_px]) / 2
    focal = np.array([camera.intrinsics_px.fx, camera.intrinsics_px.fy])
    angles = rng.uniform(-1, 1, (count, 2)) * np.minimum(spread / focal, 1.4)
    distance = np.exp(rng.uniform(low, high, count))
    rays = np.column_stack([np.tan(angles), np.ones(count)])
    return np.asarray(rays * (distance / np.linalg.norm(rays, axis=1))[:, None])


def _draw_rays(rng: Rng, camera: Camera, count: int) -> Array:
    """(at most count, 3) unit rays of pixels all over the image."""
    pixels = rng.random((count, 2)) * [camera.width_px, camera.height_px] - 0.5
    if camera.model in ("omnidirectional", "equirectangular"):
        rays, valid = unproject(camera.lens, pixels)
        return np.asarray(rays[valid])
    plane = np.column_stack([normalized(camera, pixels), np.ones(count)])
    return np.asarray(plane / np.linalg.norm(plane, axis=1)[:, None])


def _draw_on_street(rng: Rng, camera: Camera, count: int) -> Array:
    """(at most count, 3) points of a street in the camera frame that a LiDAR sees."""
    rays = _draw_rays(rng, camera, count)
    count = len(rays)
    T_lidar_camera = invert(camera.T_camera_lidar)
    rays = rays @ T_lidar_camera[:3, :3].T
    origin, wall = T_lidar_camera[:3, 3], np.sign(rays[:, 1]) * rng.uniform(*_WALLS_M)
    with np.errstate(divide="ignore"):
        ground = (-_LIDAR_HEIGHT_M - origin[2]) / np.minimum(rays[:, 2], 0)
        aside = (wall - origin[1]) / rays[:, 1]
    distance = np.minimum(np.minimum(np.abs(ground), np.abs(aside)), _FAR_M)
    nearer = rng.random(count) < _CLUTTER
    distance[nearer] *= rng.uniform(0.4, 1.0, np.count_nonzero(nearer))
    points = origin + distance[:, None] * rays
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    seen = (elevation > _BEAMS_RAD[0]) & (elevation < _BEAMS_RAD[1])
    return np.asarray((points[seen] - origin) @ T_lidar_camera[:3, :3])
