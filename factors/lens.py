"""Lens models: from a point in the camera frame to a pixel, with the derivative.

The formulas are OpenCV's (``projectPoints``, ``fisheye.projectPoints``, ``omnidir.projectPoints``)
inside the field of view in which they are one-to-one. Outside (behind the camera, or past the field
angle at which the distortion polynomial folds back) OpenCV returns pixels that mean nothing; here
such a point is reported as invalid, and its projection is continued continuously (see
``lens_kernels.project_one``), so that an optimizer that steps there gets a large, finite error
instead of a NaN or a wrong small one. :func:`unproject` is the inverse, for any lens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.arrays import contiguous
from factors.kernel import COLUMNS, RESIDUALS, pass_over
from factors.lens_kernels import FISHEYE, LIMIT, OMNIDIRECTIONAL, PINHOLE

Array = NDArray[np.float64]
LensModel = Literal["pinhole", "fisheye", "omnidirectional"]

COEFFICIENTS: dict[LensModel, tuple[int, ...]] = {
    "pinhole": (0, 4, 5, 8),
    "fisheye": (4,),
    "omnidirectional": (5,),
}
"""How many distortion coefficients each model has."""
ORDERS: dict[LensModel, str] = {
    "pinhole": "[], [k1, k2, p1, p2], [k1, k2, p1, p2, k3] or [k1, k2, p1, p2, k3, k4, k5, k6]",
    "fisheye": "[k1, k2, k3, k4]",
    "omnidirectional": "[xi, k1, k2, p1, p2]",
}
"""The distortion coefficients of each model in their order, which is OpenCV's."""
_IDENTITY = np.eye(4)[None]
_MAX_PLANE_RADIUS = math.tan(math.radians(85.0))  # polynomials are not fitted beyond
_TABLE = 500
_MAX_XI = 100.0  # beyond, the model is a parallel projection, whose focal length is not determined
_ITERATIONS = 20  # of Newton; 3 to 6 are enough but near the limit of a lens
_CONVERGED_PX = 1e-10
_MISS_PX = 0.01
_SINGULAR = 1e-9  # determinant over the square of the trace, at the limit of a lens


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens, packed for the kernels. Build it with :meth:`of`.

    Attributes:
        kind: of ``lens_kernels``: PINHOLE, FISHEYE or OMNIDIRECTIONAL.
        packed: (13,) fx fy cx cy [px], eight distortion coefficients in the order of ``ORDERS``,
            then zeros, and the limit of the injective domain: a normalised radius (pinhole) or a
            field angle [rad] (fisheye, omnidirectional).
    """

    kind: int
    packed: Array

    @staticmethod
    def of(
        model: LensModel,
        *,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        distortion: Sequence[float] = (),
    ) -> Lens:
        """A lens of a model, with OpenCV's coefficients in the order of ``ORDERS``.

        ``pinhole`` has OpenCV's radial-tangential distortion; ``fisheye`` is Kannala and Brandt's
        (OpenCV ``fisheye``, Kalibr and ROS ``equidistant``); ``omnidirectional`` is the unified
        model of Mei (OpenCV ``omnidir``, Kalibr ``omni-radtan``), with 0 <= xi.

        Raises:
            ValueError: on another number of coefficients, or a focal length that is not positive.
        """
        if not (fx > 0 and fy > 0):
            raise ValueError(f"focal lengths must be positive, found fx={fx}, fy={fy}")
        if len(distortion) not in COEFFICIENTS[model]:
            allowed = ", ".join(map(str, COEFFICIENTS[model]))
            raise ValueError(
                f"{len(distortion)} distortion coefficients found, "
                f"expected {allowed}: {ORDERS[model]}"
            )
        none = [0.0] * (8 - len(distortion))
        return Lens.limited(_KINDS[model], np.array([fx, fy, cx, cy, *distortion, *none], float))

    @staticmethod
    def limited(kind: int, parameters: Array) -> Lens:
        """A lens of (12,) packed parameters; the limit of its domain follows from these."""
        limit = _LIMITS[kind](tuple(parameters[4:12].tolist()))
        return Lens(kind, np.append(parameters[:12], limit))

    @property
    def pixels_per_rad(self) -> float:
        """Resolution along u on the camera's axis [px/rad]."""
        fx = float(self.packed[0])
        return fx / (1.0 + float(self.packed[4])) if self.kind == OMNIDIRECTIONAL else fx

    def project(
        self, points_m: ArrayLike, T_camera_points: Array | None = None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Project points.

        Args:
            points_m: (n, 3).
            T_camera_points: (4, 4) of their frame; None: they are in the camera frame.

        Returns:
            (n, 2) pixels, and (n,) whether each is a real projection (in front of the camera and
            inside the injective domain of the lens). It may still lie outside the image.
        """
        columns = _columns(points_m)
        T = _IDENTITY if T_camera_points is None else T_camera_points[None]
        pixels, valid = np.empty((columns.shape[1], 2)), np.empty(columns.shape[1], np.bool_)
        pass_over(self.kind, self.packed, T, columns, RESIDUALS, pixels, flags=valid)
        return pixels, valid

    def project_with_jacobian(self, points_camera_m: ArrayLike) -> tuple[Array, Array]:
        """Project points: (n, 2) pixels, and their (n, 2, 3) derivatives by the points."""
        columns = _columns(points_camera_m)
        found = np.empty((7, 2, columns.shape[1]))
        pass_over(self.kind, self.packed, _IDENTITY, columns, COLUMNS, found)
        return found[6].T, -found[3:6].T


def _columns(points_m: ArrayLike) -> Array:
    """(5, n) columns of points at the pixel (0, 0)."""
    points = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
    columns = np.zeros((5, len(points)))
    columns[:3] = points.T
    return contiguous(columns)


def _smallest_positive_root(polynomial: NDArray[Any]) -> float:
    """Smallest positive real root of a polynomial (coefficients by rising power), else inf."""
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(polynomial, "b"))
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min()) if len(real) else math.inf


@lru_cache(maxsize=64)  # the same few lenses are built for every copy of a rig
def _radtan_limit(coefficients: tuple[float, ...]) -> float:
    """Radius at which d/dr [r N(r^2) / D(r^2)] first vanishes or D does, without tangential terms.

    At most the radius of a ray 85 degrees off the axis: polynomials are not fitted beyond.
    """
    if not any(coefficients):
        return math.inf
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    numerator = np.polynomial.Polynomial([1.0, k1, k2, k3])
    denominator = np.polynomial.Polynomial([1.0, k4, k5, k6])
    s = np.polynomial.Polynomial([0.0, 1.0])
    slope = numerator * denominator + 2 * s * (
        numerator.deriv() * denominator - numerator * denominator.deriv()
    )
    root = math.sqrt(min(_smallest_positive_root(p.coef) for p in (slope, denominator)))
    return min(root, _MAX_PLANE_RADIUS)


def _fisheye_limit(coefficients: tuple[float, ...]) -> float:
    """Field angle at which the distorted angle stops growing, at most just under 180 degrees."""
    slope = np.array([1.0, *np.multiply(coefficients[:4], [3.0, 5.0, 7.0, 9.0])])
    return min(math.sqrt(_smallest_positive_root(slope)), math.radians(179.0))


def check_mirror(xi: float) -> None:
    """Check the unified model's xi: 0 is a pinhole, 1 a parabolic mirror, more a fisheye.

    Raises:
        ValueError: if it is negative or far too large.
    """
    if not 0 <= xi <= _MAX_XI:
        raise ValueError(f"xi of the unified model is {xi:g}, expected 0 to {_MAX_XI:g}")


def _omnidirectional_limit(coefficients: tuple[float, ...]) -> float:
    """Field angle [rad] up to which the unified model is one-to-one, without tangential terms.

    At the least of the angles at which the plane's radius stops growing (arccos(-1 / xi), xi > 1),
    at which the polynomial does, and at which the radius equals a pinhole's at 85 degrees.
    """
    xi, k1, k2 = coefficients[:3]
    check_mirror(xi)
    slope = np.array([1.0, 3.0 * k1, 5.0 * k2])
    radius = min(_MAX_PLANE_RADIUS, math.sqrt(_smallest_positive_root(slope)))
    # sin(t) / (cos(t) + xi) = radius:  sin(t - atan(radius)) = xi radius / sqrt(1 + radius^2).
    sine = xi * radius / math.hypot(1.0, radius)
    if sine >= 1.0:
        return math.acos(-1.0 / xi)
    return math.atan(radius) + math.asin(sine)


_KINDS: dict[LensModel, int] = {
    "pinhole": PINHOLE,
    "fisheye": FISHEYE,
    "omnidirectional": OMNIDIRECTIONAL,
}
_LIMITS: dict[int, Callable[[tuple[float, ...]], float]] = {
    PINHOLE: _radtan_limit,
    FISHEYE: _fisheye_limit,
    OMNIDIRECTIONAL: _omnidirectional_limit,
}


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
        missing = pixels - projected
        if not len(rays) or np.abs(missing).max() < _CONVERGED_PX:
            break
        rays = rays + np.einsum("nij,nj->ni", _right_inverse(by_ray), missing)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    back, valid = lens.project(rays)
    with np.errstate(invalid="ignore"):
        return rays, valid & (np.abs(back - pixels).max(axis=1, initial=0.0) < _MISS_PX)


def ray_spreads(lens: Lens, rays: Array) -> Array:
    """(n, 3, 2) derivatives of unit rays by their pixels [1/px]; orthogonal to the rays.

    A projection does not depend on the length of its argument, so the rays are the null spaces of
    its derivatives, and the right inverses of these are orthogonal to them.
    """
    return _right_inverse(lens.project_with_jacobian(rays)[1])


def _right_inverse(jacobians: Array) -> Array:
    """(n, 3, 2) J^T (J J^T)^-1 of (n, 2, 3) J."""
    u, v = jacobians[:, 0], jacobians[:, 1]
    a, b, c = (np.einsum("ni,ni->n", *of)[:, None] for of in ((u, u), (u, v), (v, v)))
    over = 1.0 / np.maximum(a * c - b * b, _SINGULAR * (a + c) ** 2)
    return np.stack([over * (c * u - b * v), over * (a * v - b * u)], axis=2)


def _first_rays(lens: Lens, pixels: Array) -> Array:
    """(n, 3) rays without tangential distortion; of a pinhole, without any."""
    (fx, fy, cx, cy), limit = lens.packed[:4], lens.packed[LIMIT]
    plane = np.column_stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy])
    radius = np.maximum(np.hypot(*plane.T), np.finfo(float).tiny)
    if lens.kind == PINHOLE:
        inside = np.minimum(1.0, limit / radius)
        rays = np.column_stack([plane * inside[:, None], np.ones(len(plane))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    angles = np.linspace(0.0, limit, _TABLE)
    along = np.column_stack([np.sin(angles), np.zeros(_TABLE), np.cos(angles)])
    distances = np.maximum.accumulate((lens.project(along)[0][:, 0] - cx) / fx)
    angle = np.interp(radius, distances, angles)
    return np.column_stack([plane * (np.sin(angle) / radius)[:, None], np.cos(angle)])
