"""Directions: view angles of a camera, and one direction per cell of the sphere."""

import math

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array

Rows = NDArray[np.intp]


def view_angles(points_camera_m: Array) -> Array:
    """(n, 2) angles [rad] to the right of, and below, the camera's axis; for any field of view."""
    x, y, z = points_camera_m.T
    return np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])


def scan_angles(rays_m: Array) -> Array:
    """(n, 2) angles [rad] along scan lines about the LiDAR's z axis, and across them.

    Along is the arc from the x axis, so that both are angles in space.

    Args:
        rays_m: (n, 3) from the viewpoint, along the axes of the LiDAR frame.
    """
    x, y, z = rays_m.T
    elevation = np.arctan2(z, np.hypot(x, y))
    return np.column_stack([np.arctan2(y, x) * np.cos(elevation), elevation])


def thin(rays: Array, cell_rad: float) -> Rows:
    """Keep one direction per cell of the sphere, the one nearest to its centre.

    Rows of cells lie along circles of equal elevation about the z axis, as scan lines do.

    Args:
        rays: (n, 3) of any length, in any order.
        cell_rad: side of a cell.

    Returns:
        Rows of the directions that are kept, by cell.
    """
    if not len(rays):
        return np.empty(0, np.intp)
    x, y, z = np.asarray(rays, dtype=np.float64).T
    up = np.arctan2(z, np.hypot(x, y)) / cell_rad
    row = np.floor(up)
    along = (np.arctan2(y, x) + math.pi) * np.cos((row + 0.5) * cell_rad) / cell_rad
    column = np.floor(along)
    off = (along - column - 0.5) ** 2 + (up - row - 0.5) ** 2
    columns = math.ceil(2 * math.pi / cell_rad) + 1
    cell = ((row - row.min()) * columns + column).astype(np.intp)
    least = np.full(cell.max() + 1, np.inf)
    np.minimum.at(least, cell, off)
    nearest = np.full(len(least), len(rays), np.intp)
    kept = np.flatnonzero(off == least[cell])
    np.minimum.at(nearest, cell[kept], kept)
    return nearest[nearest < len(rays)]
