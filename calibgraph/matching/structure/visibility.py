"""Which points of a cloud a camera sees."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.structure.directions import view_angles
from calibgraph.model.rig import Camera
from factors import unproject
from factors.lens_kernels import EQUIRECTANGULAR, PINHOLE, RADTAN

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Mask = NDArray[np.bool_]

HIDDEN_RATIO, HIDDEN_M = 1.15, 0.3  # a point farther than this beyond the nearest is hidden
_BORDER_PIXELS, _COSINE_MARGIN = 17, 0.99  # of each side of an image; what lies between them


def find_in_view(points_lidar_m: Array, camera: Camera) -> tuple[Rows, Array, Array]:
    """Find the points that project into a camera's image.

    Args:
        points_lidar_m: (n, 3) in the LiDAR frame.
        camera: lens, image size and extrinsic.

    Returns:
        (k,) their rows; (k, 2) view angles [rad], see :func:`directions.view_angles`; (k,)
        distances from the camera [m].
    """
    T, least = camera.T_camera_lidar, _least_cosine(camera)
    points = np.asarray(points_lidar_m) @ T[:3, :3].T + T[:3, 3]
    distance_m = np.sqrt(np.einsum("ij,ij->i", points, points))
    rows = np.flatnonzero(points[:, 2] >= least * distance_m)
    pixels, valid = camera.lens.project(points[rows])
    places = pixels + 0.5
    inside = (places >= 0) & (places < (camera.width_px, camera.height_px))
    rows = rows[valid & inside.all(axis=1)]
    return rows, view_angles(points[rows]), distance_m[rows]


def find_visible(angles: Array, distance_m: Array, cell_rad: float) -> Mask:
    """Find the points that no much nearer point of the same cell hides.

    Args:
        angles: (n, 2) [rad].
        distance_m: (n,).
        cell_rad: side of a cell.
    """
    if not len(angles):
        return np.empty(0, np.bool_)
    columns, rows = (angles - angles.min(axis=0)).T
    columns, rows = (columns / cell_rad).astype(np.intp), (rows / cell_rad).astype(np.intp)
    cell = columns * (rows.max() + 1) + rows
    nearest_m = np.full(cell.max() + 1, np.inf)
    np.minimum.at(nearest_m, cell, distance_m)
    return np.asarray(distance_m < HIDDEN_RATIO * nearest_m[cell] + HIDDEN_M)


def find_places(
    rays_m: NDArray[np.float32], viewpoint_lidar_m: Array, camera: Camera, scale: Array
) -> NDArray[np.int32]:
    """(w, l, 2) nearest pixels, of an image scaled by (2,), to the ends of rays (w, l, 3)."""
    T = camera.T_camera_lidar
    points = (rays_m.reshape(-1, 3) + viewpoint_lidar_m) @ T[:3, :3].T + T[:3, 3]
    pixels = camera.lens.project_with_jacobian(points)[0]
    if camera.lens.kind == EQUIRECTANGULAR:  # a window across the seam of a panorama stays whole
        centres = pixels.reshape(rays_m.shape[:2] + (2,))[:, :1].repeat(rays_m.shape[1], axis=1)
        pixels = centres.reshape(-1, 2) + camera.lens.subtract(pixels, centres.reshape(-1, 2))
    places = np.rint((pixels + 0.5) * scale - 0.5).astype(np.int32)
    return places.reshape(rays_m.shape[:2] + (2,))


def _least_cosine(camera: Camera) -> float:
    """Smallest cosine of the angle to the camera's axis in its image; -1 if any may be."""
    u = np.linspace(-0.5, camera.width_px - 0.5, _BORDER_PIXELS)
    v = np.linspace(-0.5, camera.height_px - 0.5, _BORDER_PIXELS)
    sides = [np.column_stack([u, np.full_like(u, end)]) for end in (v[0], v[-1])]
    sides += [np.column_stack([np.full_like(v, end), v]) for end in (u[0], u[-1])]
    rays, valid = unproject(camera.lens, np.concatenate(sides))
    if not valid.all() or camera.lens.kind not in (PINHOLE, RADTAN):
        return -1.0
    return float(rays[:, 2].min()) * _COSINE_MARGIN
