"""Directions: view angles of a camera, and one direction per cell of the sphere."""

import math

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from factors.compiled import compiled

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
    lowest, highest = (math.floor(f(angles[:, 1]) / cell_rad) for f in (np.min, np.max))
    cosine = np.cos((np.arange(highest - lowest + 1) + float(lowest) + 0.5) * cell_rad)
    cells, off = np.empty((len(angles), 2), np.intp), np.empty(len(angles))
    first, last = _find_cells(np.ascontiguousarray(angles), cell_rad, lowest, cosine, cells, off)
    nearest = np.full((len(cosine), last - first + 1), -1, np.int32)
    rows = np.empty(len(angles) + 1, np.intp)
    return rows[: _find_nearest(cells, off, first, nearest, rows)]


@compiled()
def _find_cells(angles, cell, lowest, cosine, cells, off):  # type: ignore[no-untyped-def]
    """Fill each direction's cell (row, column), and its squared distance from the centre.

    Returns:
        The first and the last column.
    """
    first, last = 1 << 62, -1
    for i in range(len(angles)):
        up = angles[i, 1] / cell
        floor = math.floor(up)
        row = floor - lowest
        along = (angles[i, 0] + math.pi) * cosine[row] / cell
        column = math.floor(along)
        x, y = along - column - 0.5, up - floor - 0.5
        cells[i, 0], cells[i, 1], off[i] = row, column, x * x + y * y
        first, last = min(first, column), max(last, column)
    return first, last


@compiled()
def _find_nearest(cells, off, first, nearest, rows):  # type: ignore[no-untyped-def]
    """Fill in by cell the number of its nearest direction; of equally near ones, the first.

    Returns:
        How many there are.
    """
    for i in range(len(cells)):
        row, column = cells[i, 0], cells[i, 1] - first
        before = nearest[row, column]
        if before < 0 or off[i] < off[before]:
            nearest[row, column] = i
    count = np.int64(0)
    for number in nearest.ravel():  # most are empty: a branch would be mispredicted
        rows[count] = number
        count += number >= 0
    return count
