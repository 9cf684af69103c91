"""Which points of a cloud a camera sees."""

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, Mask
from calibgraph.model.rig import Camera
from factors import unproject
from factors.arrays import contiguous
from factors.compiled import compiled
from factors.lens_kernels import PINHOLE, is_projectable, project_one

Rows = NDArray[np.intp]

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
    lens, T = camera.lens, contiguous(camera.T_camera_lidar)
    points = contiguous(np.asarray(points_lidar_m, dtype=np.float64))
    rows = np.empty(len(points), np.intp)
    views = np.empty((len(points), 3))
    count = _find_in_view(lens.kind)(
        lens.packed, T, points, camera.width_px, camera.height_px, _least_cosine(camera),
        rows, views,
    )  # fmt: skip
    return rows[:count], views[:count, :2], views[:count, 2]


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
    lens, T = camera.lens, contiguous(camera.T_camera_lidar)
    places = np.empty((*rays_m.shape[:2], 2), np.int32)
    _find_places(lens.kind)(lens.packed, T, viewpoint_lidar_m, scale, rays_m, places)
    return places


@cache
def _find_places(kind: int) -> Any:
    @compiled()
    def run(lens, T, viewpoint, scale, rays_m, places):  # type: ignore[no-untyped-def]
        for w in range(rays_m.shape[0]):
            for p in range(rays_m.shape[1]):
                px, py = rays_m[w, p, 0] + viewpoint[0], rays_m[w, p, 1] + viewpoint[1]
                pz = rays_m[w, p, 2] + viewpoint[2]
                x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
                y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
                z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
                projection = project_one(kind, lens, x, y, z)
                places[w, p, 0] = round((projection[0] + 0.5) * scale[0] - 0.5)
                places[w, p, 1] = round((projection[1] + 0.5) * scale[1] - 0.5)

    return run


def _least_cosine(camera: Camera) -> float:
    """Smallest cosine of the angle to the camera's axis in its image; -1 if any may be."""
    u = np.linspace(-0.5, camera.width_px - 0.5, _BORDER_PIXELS)
    v = np.linspace(-0.5, camera.height_px - 0.5, _BORDER_PIXELS)
    sides = [np.column_stack([u, np.full_like(u, end)]) for end in (v[0], v[-1])]
    sides += [np.column_stack([np.full_like(v, end), v]) for end in (u[0], u[-1])]
    rays, valid = unproject(camera.lens, np.concatenate(sides))
    if not valid.all() or camera.lens.kind != PINHOLE:
        return -1.0
    return float(rays[:, 2].min()) * _COSINE_MARGIN


@cache
def _find_in_view(kind: int) -> Any:
    @compiled()
    def run(lens, T, points, width, height, least_cosine, rows, views):  # type: ignore[no-untyped-def]
        count = 0
        for i in range(len(points)):
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
            y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
            z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            squared = x * x + y * y + z * z
            if least_cosine > 0 and (z <= 0 or z * z < least_cosine * least_cosine * squared):
                continue
            if not is_projectable(kind, lens, x, y, z):
                continue
            projection = project_one(kind, lens, x, y, z)
            u, v = projection[0] + 0.5, projection[1] + 0.5
            if u < 0 or v < 0 or u >= width or v >= height:
                continue
            rows[count] = i
            views[count, 0] = math.atan2(x, z)
            views[count, 1] = math.atan2(y, math.sqrt(x * x + z * z))
            views[count, 2] = math.sqrt(squared)
            count += 1
        return count

    return run
