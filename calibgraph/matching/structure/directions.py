"""Directions: view angles of a camera, and one direction per cell of the sphere."""

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]
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
    azimuth, elevation = np.empty((2, len(rays)))
    _to_angles(rays, azimuth, elevation)
    first, last = (math.floor(end / cell_rad) for end in (elevation.min(), elevation.max()))
    columns = math.ceil(2 * math.pi / cell_rad) + 1
    nearest = np.full((last - first + 1) * columns, -1, np.intp)
    _keep_nearest(azimuth, elevation, cell_rad, first, columns, nearest)
    return nearest[nearest >= 0]


@compiled()
def _to_angles(rays, azimuth, elevation):  # type: ignore[no-untyped-def]
    """Azimuth from the negative x axis, in (0, 2 pi]; elevation over the xy plane."""
    for i in range(len(rays)):
        x, y, z = rays[i, 0], rays[i, 1], rays[i, 2]
        azimuth[i] = math.atan2(y, x) + math.pi
        elevation[i] = math.atan2(z, math.sqrt(x * x + y * y))


@compiled()
def _keep_nearest(azimuth, elevation, cell_rad, first, columns, nearest):  # type: ignore[no-untyped-def]
    """The direction nearest to the centre of each cell; its squared distance is in cells."""
    least = np.empty(len(nearest))
    for i in range(len(azimuth)):
        up = elevation[i] / cell_rad
        row = math.floor(up)
        along = azimuth[i] * math.cos((row + 0.5) * cell_rad) / cell_rad
        column = math.floor(along)
        off = (along - column - 0.5) ** 2 + (up - row - 0.5) ** 2
        cell = (row - first) * columns + column
        if nearest[cell] < 0 or off < least[cell]:
            nearest[cell], least[cell] = i, off
