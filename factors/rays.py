"""Viewing rays of pixels: the inverse of :class:`factors.lens.Lens`, for any lens."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.lens import Lens
from factors.lens_kernels import EQUIRECTANGULAR, FISHEYE, OMNIDIRECTIONAL
from factors.wide_lenses import equirectangular_rays, first_omnidirectional_rays

Array = NDArray[np.float64]

_ITERATIONS = 20  # of Newton; 3 to 6 are enough but near the limit of a lens
_CONVERGED_PX = 1e-10
_MISS_PX = 0.01
_SINGULAR = 1e-9  # determinant over the square of the trace, at the limit of a lens


def unproject(lens: Lens, pixels_px: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Viewing rays of pixels, by Newton's method on the unit sphere.

    Args:
        lens: the camera's lens.
        pixels_px: (n, 2) column and row.

    Returns:
        (n, 3) unit vectors in the camera frame, and (n,) whether the lens projects each to its
        pixel. The others mean nothing.
    """
    pixels = np.asarray(pixels_px, dtype=np.float64).reshape(-1, 2)
    rays = _first_rays(lens, pixels)
    for _ in range(_ITERATIONS):
        projected, by_ray = lens.project_with_jacobian(rays)
        missing = lens.subtract(pixels, projected)
        if not len(rays) or np.abs(missing).max() < _CONVERGED_PX:
            break
        rays = rays + np.einsum("nij,nj->ni", _right_inverse(by_ray), missing)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    back, valid = lens.project(rays)
    with np.errstate(invalid="ignore"):
        return rays, valid & (
            np.abs(lens.subtract(back, pixels)).max(axis=1, initial=0.0) < _MISS_PX
        )


def ray_spreads(lens: Lens, rays: Array) -> Array:
    """(n, 3, 2) derivatives of unit rays by their pixels [1/px]; orthogonal to the rays.

    A projection does not depend on the length of its argument, so the rays are the null spaces of
    its derivatives, and the right inverses of these are orthogonal to them.
    """
    return _right_inverse(lens.project_with_jacobian(rays)[1])


def _right_inverse(jacobians: Array) -> Array:
    """(n, 3, 2) J^T (J J^T)^-1 of (n, 2, 3) J."""
    gram = jacobians @ jacobians.transpose(0, 2, 1)
    a, b, c = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
    over = 1.0 / np.maximum(a * c - b * b, _SINGULAR * (a + c) ** 2)
    inverse = np.stack([c, -b, -b, a], axis=-1).reshape(-1, 2, 2) * over[:, None, None]
    return np.asarray(jacobians.transpose(0, 2, 1) @ inverse)


def _first_rays(lens: Lens, pixels: Array) -> Array:
    """(n, 3) rays without distortion."""
    fx, fy, cx, cy = lens.packed[:4]
    x, y = (pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy
    if lens.kind == EQUIRECTANGULAR:
        return equirectangular_rays(np.column_stack([x, y]))
    if lens.kind == OMNIDIRECTIONAL:
        return first_omnidirectional_rays(lens.packed, np.column_stack([x, y]))
    radius = np.hypot(x, y)
    if lens.kind == FISHEYE:
        angle = np.minimum(radius, 0.9 * lens.packed[-1])
        sideways = np.sin(angle) / np.maximum(radius, np.finfo(float).tiny)
        return np.column_stack([x * sideways, y * sideways, np.cos(angle)])
    inside = np.minimum(1.0, lens.packed[-1] / np.maximum(radius, np.finfo(float).tiny))
    rays = np.column_stack([x * inside, y * inside, np.ones(len(x))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
