"""Scans of a street, a ground plane with boxes on it, from any pose; no renderer is needed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def _boxes(seed: int) -> Array:
    """(n, 2, 3) lower and upper corners: houses along the x axis, and lower things."""
    rng = np.random.default_rng(seed)
    n, ahead = 50, np.arange(-50.0, 100.0, 15.0)
    houses = [(x, y) for x in ahead for y in (-16.0, 16.0)]
    corner = np.vstack([houses, np.column_stack([rng.uniform(-50, 100, n), rng.uniform(4, 12, n)])])
    corner[len(houses) :, 1] *= rng.choice([-1, 1], n)
    corner += rng.uniform(-2, 2, corner.shape)
    size = rng.uniform((0.3, 0.3, 1), (3, 2, 4), (len(corner), 3))
    size[: len(houses)] = rng.uniform((6, 4, 5), (12, 8, 12), (len(houses), 3))
    low = np.column_stack([corner - size[:, :2] / 2, np.zeros(len(corner))])
    return np.stack([low, low + size], axis=1)


_BOXES = _boxes(seed=0)
_AZIMUTH, _ELEVATION = np.meshgrid(np.radians(range(360)), np.radians(range(-20, 12)))
_FLAT = np.cos(_ELEVATION)
_RAYS = np.stack([_FLAT * np.cos(_AZIMUTH), _FLAT * np.sin(_AZIMUTH), np.sin(_ELEVATION)], -1)


def _pose(x_m: float) -> Array:
    T_world_lidar = np.eye(4)
    T_world_lidar[:3, 3] = x_m, 0.0, 1.8
    return T_world_lidar


STOPS = [_pose(9.0 * number) for number in range(6)]
"""(4, 4) T_world_lidar of a vehicle that drives along the street."""


def scan_at(T_world_lidar: Array, seed: int) -> NDArray[np.float32]:
    """(n, 3) the points that a LiDAR of 32 beams sees up to 80 m, with 2 cm of noise."""
    rays = _RAYS.reshape(-1, 3)
    direction, origin = rays @ T_world_lidar[:3, :3].T, T_world_lidar[:3, 3]
    with np.errstate(divide="ignore"):
        range_m = np.where(direction[:, 2] < 0, -origin[2] / direction[:, 2], np.inf)
        inverse = 1.0 / direction
    for box in _BOXES:  # a ray is inside between its last entry and its first exit of three slabs
        at = np.sort((box[:, None] - origin) * inverse, axis=0)
        enters, leaves = at[0].max(axis=1), at[1].min(axis=1)
        hit = (enters > 0) & (enters < np.minimum(leaves, range_m))
        range_m[hit] = enters[hit]
    range_m += np.random.default_rng(seed).normal(0, 0.02, len(range_m))
    seen = range_m < 80
    return (rays[seen] * range_m[seen, None]).astype(np.float32)


def displaced(T_world_lidar: Array, *, left_m: float, turned_deg: float) -> Array:
    """(4, 4) the pose beside a stop."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    T[1, 3] = left_m
    return T_world_lidar @ T
