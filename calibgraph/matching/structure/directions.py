"""Directions: view angles of a camera, and one direction per cell of the sphere."""

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array

Rows = NDArray[np.intp]


def view_angles(points_camera_m: Array) -> Array:
    """(n, 2) angles [rad] to the right of, and below, the camera's axis; for any field of view."""
    x, y, z = points_camera_m.T
    return np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])


def scan_angles(angles: Array) -> Array:
    """(n, 2) angles [rad] along scan lines about the LiDAR's z axis, and across them.

    Along is the arc from the x axis, so that both are angles in space.

    Args:
        angles: (n, 2) see :func:`sphere_angles`.
    """
    azimuth, elevation = angles.T
    return np.column_stack([azimuth * np.cos(elevation), elevation])


def sphere_angles(rays_m: Array) -> Array:
    """(n, 2) azimuth from the x axis and elevation [rad], about the LiDAR's z axis.

    Args:
        rays_m: (n, 3) from the viewpoint, along the axes of the LiDAR frame.
    """
    x, y, z = np.asarray(rays_m, dtype=np.float64).T
    return np.column_stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])


def thin(angles: Array, cell_rad: float) -> Rows:
    """Keep one direction per cell of the sphere, the one nearest to its centre.

    Rows of cells lie along circles of equal elevation about the z axis, as scan lines do.

    Args:
        angles: (n, 2) see :func:`sphere_angles`, in any order.
        cell_rad: side of a cell.

    Returns:
        Rows of the directions that are kept, by cell: by rows of cells, and by azimuth.
    """
    if not len(angles):
        return np.empty(0, np.intp)
    up = angles[:, 1] / cell_rad
    row = np.floor(up)
    along = (angles[:, 0] + np.pi) * np.cos((row + 0.5) * cell_rad) / cell_rad
    column = np.floor(along)
    off = (along - column - 0.5) ** 2 + (up - row - 0.5) ** 2
    row, column = row - row.min(), column - column.min()
    cells = (row * (column.max() + 1) + column).astype(np.intp)
    nearest = np.full(cells.max() + 1, np.inf)
    np.minimum.at(nearest, cells, off)
    rows = np.flatnonzero(off == nearest[cells])
    return rows[np.unique(cells[rows], return_index=True)[1]]  # of equally near ones, the first
