"""Directions: angles, one direction per cell of the sphere, and which points a camera sees."""

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, Mask, name_cells
from calibgraph.model.geometry import move_points
from calibgraph.model.rig import Camera

Rows = NDArray[np.intp]

HIDDEN_RATIO, HIDDEN_M = 1.15, 0.3  # a point farther than this beyond the nearest is hidden


def view_angles(points_camera_m: Array) -> Array:
    """(n, 2) angles [rad] to the right of, and below, the camera's axis; for any field of view."""
    x, y, z = points_camera_m.T
    return np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))]).T


def scan_angles(angles: Array) -> Array:
    """(n, 2) angles [rad] along scan lines about the LiDAR's z axis, and across them.

    Along is the arc from the x axis, so that both are angles in space.

    Args:
        angles: (n, 2) see :func:`sphere_angles`.
    """
    azimuth, elevation = angles.T
    return np.stack([azimuth * np.cos(elevation), elevation]).T


def sphere_angles(rays_m: Array) -> Array:
    """(n, 2) azimuth from the x axis and elevation [rad], about the LiDAR's z axis.

    Args:
        rays_m: (n, 3) from the viewpoint, along the axes of the LiDAR frame.
    """
    x, y, z = np.asarray(rays_m, dtype=np.float64).T
    return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))]).T


def thin(angles: Array, cell_rad: float) -> Rows:
    """Keep one direction per cell of the sphere, the one nearest to its centre.

    Rows of cells lie along circles of equal elevation about the z axis, as scan lines do.

    Args:
        angles: (n, 2) see :func:`sphere_angles`, in any order.
        cell_rad: side of a cell.

    Returns:
        Rows of the directions that are kept, by cell: by rows of cells, and by azimuth.
    """
    up = angles[:, 1] / cell_rad
    row = np.floor(up)
    along = (angles[:, 0] + np.pi) * np.cos((row + 0.5) * cell_rad) / cell_rad
    off = (along - np.floor(along) - 0.5) ** 2 + (up - row - 0.5) ** 2
    cells, nearest = _nearest_in_cells(np.stack([up, along]).T, off)
    rows = np.flatnonzero(off == nearest)
    return rows[np.unique(cells[rows], return_index=True)[1]]  # of equally near ones, the first


def _nearest_in_cells(places: Array, distance: Array) -> tuple[NDArray[np.int64], Array]:
    """The cells of places, as of :func:`name_cells`, and the (n,) least distances in them."""
    cells = name_cells(places)
    nearest = np.full(cells.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cells, distance)
    return cells, nearest[cells]


def find_in_view(points_lidar_m: Array, camera: Camera) -> tuple[Rows, Array, Array]:
    """Find the points that project into a camera's image.

    Args:
        points_lidar_m: (n, 3) in the LiDAR frame.
        camera: lens, image size and extrinsic.

    Returns:
        (k,) their rows; (k, 2) view angles [rad], see :func:`view_angles`; (k,)
        distances from the camera [m].
    """
    T = camera.T_camera_lidar
    is_ahead = points_lidar_m @ T[2, :3] > -T[2, 3]
    rows = np.flatnonzero(is_ahead | (camera.model != "pinhole"))
    points_m = points_lidar_m.take(rows, axis=0)
    pixels, valid = camera.lens.project(points_m, T)
    seen = np.flatnonzero(valid & camera.in_image(pixels))
    seen_m = move_points(points_m.take(seen, axis=0), T)
    return rows[seen], view_angles(seen_m), np.sqrt(np.einsum("ni,ni->n", seen_m, seen_m))


def find_visible(angles: Array, distance_m: Array, cell_rad: float) -> Mask:
    """Find the points that no much nearer point of the same cell hides.

    Args:
        angles: (n, 2) [rad].
        distance_m: (n,).
        cell_rad: side of a cell.
    """
    _, nearest_m = _nearest_in_cells(
        (angles - angles.min(axis=0, initial=np.inf)) / cell_rad, distance_m
    )
    return np.asarray(distance_m < HIDDEN_RATIO * nearest_m + HIDDEN_M)


def find_places(
    rays_m: NDArray[np.float32], viewpoint_lidar_m: Array, camera: Camera, scale: Array
) -> NDArray[np.int32]:
    """(w, l, 2) nearest pixels, of an image scaled by (2,), to the ends of rays (w, l, 3)."""
    pixels, _ = camera.lens.project(rays_m + viewpoint_lidar_m, camera.T_camera_lidar)
    pixels = pixels.reshape(*rays_m.shape[:2], 2)
    return np.rint((pixels + 0.5) * scale - 0.5).astype(np.int32)
