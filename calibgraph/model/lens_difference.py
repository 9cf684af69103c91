"""Where two lenses see the same ray."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera

_DIRECTIONS = 20_000  # of a sphere, 2 degrees apart, to begin with
_STEPS, _CONVERGED_PX = 20, 1e-3
_GOLDEN = (1.0 + 5.0**0.5) / 2.0


def has_other_lens(camera: Camera, other: Camera) -> bool:
    """Whether two lenses differ, or the sizes of their images."""
    one, two = (
        (each.width_px, each.height_px, each.model, each.lens.packed.tolist())
        for each in (camera, other)
    )
    return one != two


def corner_distance_px(camera: Camera, other: Camera) -> float:
    """How far at most two lenses see the ray of a corner of the image apart.

    Infinite where one of them has no such ray, NaN where the images differ in size.
    """
    if (camera.width_px, camera.height_px) != (other.width_px, other.height_px):
        return float("nan")
    apart = lens_difference(camera, other, corners_of(camera))
    return float(np.nan_to_num(np.hypot(*apart.T), nan=np.inf).max())


def lens_difference(camera: Camera, other: Camera, pixels_px: Array) -> Array:
    """How far another lens sees the rays of some pixels from them.

    Args:
        camera: whose pixels these are.
        other: of the same image size.
        pixels_px: (n, 2).

    Returns:
        (n, 2) pixels of the other lens less these; NaN where a lens has no such ray.
    """
    seen, valid = other.lens.project(np.nan_to_num(rays := rays_of(camera, pixels_px)))
    known = valid & np.isfinite(rays).all(axis=1)
    return np.asarray(np.where(known[:, None], other.lens.subtract(seen, pixels_px), np.nan))


def rays_of(camera: Camera, pixels_px: Array) -> Array:
    """(n, 3) unit vectors in the camera frame of (n, 2) pixels; NaN where the lens has none.

    Gauss-Newton from the nearest of many directions, so any model of a lens will do.
    """
    lens, directions = camera.lens, _sphere()
    starts, valid = lens.project(directions)
    if not valid.any():
        return np.full((len(pixels_px), 3), np.nan)
    rays = directions[valid][KDTree(starts[valid]).query(pixels_px)[1]]
    for _ in range(_STEPS):
        seen, by_point = lens.project_with_jacobian(rays)
        # The derivative along a ray is zero, so the least squares step is across it.
        step = np.linalg.pinv(by_point) @ lens.subtract(pixels_px.copy(), seen)[:, :, None]
        rays = rays + step[:, :, 0]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    seen, valid = lens.project(rays)
    found = valid & (np.abs(lens.subtract(seen, pixels_px)).max(axis=1) < _CONVERGED_PX)
    return np.asarray(np.where(found[:, None], rays, np.nan))


def corners_of(camera: Camera) -> Array:
    """(4, 2) the pixels in the corners of the image."""
    right, bottom = camera.width_px - 1.0, camera.height_px - 1.0
    return np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])


def _sphere() -> Array:
    """(n, 3) unit vectors, evenly spread along a spiral."""
    number = np.arange(_DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * number / _DIRECTIONS, 2.0 * np.pi * number / _GOLDEN
    across = np.sqrt(1.0 - z * z)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])
