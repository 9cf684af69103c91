"""Which points of a cloud a camera sees."""

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, Mask
from calibgraph.matching.structure.directions import view_angles
from calibgraph.model.rig import Camera

Rows = NDArray[np.intp]

HIDDEN_RATIO, HIDDEN_M = 1.15, 0.3  # a point farther than this beyond the nearest is hidden


def find_in_view(points_lidar_m: Array, camera: Camera) -> tuple[Rows, Array, Array]:
    """Find the points that project into a camera's image.

    Args:
        points_lidar_m: (n, 3) in the LiDAR frame.
        camera: lens, image size and extrinsic.

    Returns:
        (k,) their rows; (k, 2) view angles [rad], see :func:`directions.view_angles`; (k,)
        distances from the camera [m].
    """
    T = camera.T_camera_lidar
    in_camera_m = points_lidar_m @ T[:3, :3].T + T[:3, 3]
    ahead = np.flatnonzero((in_camera_m[:, 2] > 0) | (camera.model != "pinhole"))
    pixels, valid = camera.lens.project(in_camera_m[ahead])
    rows = ahead[valid & camera.in_image(pixels)]
    return rows, view_angles(in_camera_m[rows]), np.linalg.norm(in_camera_m[rows], axis=1)


def find_visible(angles: Array, distance_m: Array, cell_rad: float) -> Mask:
    """Find the points that no much nearer point of the same cell hides.

    Args:
        angles: (n, 2) [rad].
        distance_m: (n,).
        cell_rad: side of a cell.
    """
    if not len(angles):
        return np.empty(0, np.bool_)
    rows, columns = (((a - a.min()) / cell_rad).astype(np.intp) for a in angles.T)
    cell = rows * (columns.max() + 1) + columns
    nearest_m = np.full(cell.max() + 1, np.inf)
    np.minimum.at(nearest_m, cell, distance_m)
    return np.asarray(distance_m < HIDDEN_RATIO * nearest_m[cell] + HIDDEN_M)


def find_places(
    rays_m: NDArray[np.float32], viewpoint_lidar_m: Array, camera: Camera, scale: Array
) -> NDArray[np.int32]:
    """(w, l, 2) nearest pixels, of an image scaled by (2,), to the ends of rays (w, l, 3)."""
    pixels, _ = camera.lens.project(rays_m + viewpoint_lidar_m, camera.T_camera_lidar)
    pixels = pixels.reshape(*rays_m.shape[:2], 2)
    return np.rint((pixels + 0.5) * scale - 0.5).astype(np.int32)
