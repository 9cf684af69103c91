"""Directions as angles: of the camera, of the LiDAR; thinning and visibility by their cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Mask = NDArray[np.bool_]

HIDDEN_RATIO, HIDDEN_M = 1.15, 0.3  # a point farther than this beyond the nearest is hidden


def view_angles(points_camera_m: Array) -> Array:
    """(n, 2) angles [rad] to the right of, and below, the camera's axis; for any field of view."""
    x, y, z = points_camera_m.T
    return np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])


def scan_angles(rays_m: Array) -> Array:
    """(n, 2) angles [rad] along and across scan lines about the LiDAR's z axis, from their middle.

    Args:
        rays_m: (n, 3) from the viewpoint, along the axes of the LiDAR frame.
    """
    if not len(rays_m):
        return np.empty((0, 2))
    x, y, z = rays_m.T
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    middle = np.arctan2(np.sin(azimuth).sum(), np.cos(azimuth).sum())
    along = (azimuth - middle + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([along * np.cos(elevation), elevation])


def thin(angles: Array, cell_rad: float) -> Rows:
    """Keep one of the angles per cell, the one nearest to its centre, whatever their order.

    Args:
        angles: (n, 2) [rad].
        cell_rad: side of a cell.

    Returns:
        Rows of the angles that are kept.
    """
    if not len(angles):
        return np.empty(0, np.intp)
    cells = np.floor(angles / cell_rad)
    off_centre = ((angles / cell_rad - cells - 0.5) ** 2).sum(axis=1)
    column, row = (cells - cells.min(axis=0)).astype(np.int64).T
    name = row * (column.max() + 1) + column
    order = np.lexsort((off_centre, name))
    return np.asarray(order[np.append(True, np.diff(name[order]) != 0)])


def find_visible(angles: Array, distance_m: Array, cell_rad: float) -> Mask:
    """Find the points that no much nearer point of the same cell hides.

    Args:
        angles: (n, 2) [rad].
        distance_m: (n,).
        cell_rad: side of a cell.
    """
    if not len(angles):
        return np.empty(0, np.bool_)
    cells = np.floor((angles - angles.min(axis=0)) / cell_rad).astype(np.int64)
    name = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    nearest_m = np.full(int(name.max()) + 1, np.inf)
    np.minimum.at(nearest_m, name, distance_m)
    return np.asarray(distance_m < HIDDEN_RATIO * nearest_m[name] + HIDDEN_M)
