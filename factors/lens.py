"""Lens models: from a point in the camera frame to a pixel, with the derivative.

The formulas are OpenCV's (``projectPoints``, ``fisheye.projectPoints``, ``omnidir.projectPoints``)
inside the field of view in which they are one-to-one. Outside (behind the camera, or past the field
angle at which the distortion polynomial folds back) OpenCV returns pixels that mean nothing; here
such a point is reported as invalid, and its projection is continued continuously (see
``lens_kernels.project_one``), so that an optimizer that steps there gets a large, finite error
instead of a NaN or a wrong small one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.arrays import contiguous
from factors.compiled import compiled
from factors.lens_kernels import (
    EQUIRECTANGULAR,
    FISHEYE,
    LIMIT,
    OMNIDIRECTIONAL,
    PINHOLE,
    is_projectable,
    project_one,
)
from factors.wide_lenses import check_mirror, omnidirectional_limit

Array = NDArray[np.float64]
LensModel = Literal["pinhole", "fisheye", "omnidirectional", "equirectangular"]

COEFFICIENTS: dict[LensModel, tuple[int, ...]] = {
    "pinhole": (0, 4, 5, 8),
    "fisheye": (4,),
    "omnidirectional": (5,),
    "equirectangular": (0,),
}
"""How many distortion coefficients each model has."""
ORDERS: dict[LensModel, str] = {
    "pinhole": "[], [k1, k2, p1, p2], [k1, k2, p1, p2, k3] or [k1, k2, p1, p2, k3, k4, k5, k6]",
    "fisheye": "[k1, k2, k3, k4]",
    "omnidirectional": "[xi, k1, k2, p1, p2]",
    "equirectangular": "[]",
}
"""The distortion coefficients of each model in their order, which is OpenCV's."""
_NO_PIXELS, _NO_JACOBIANS, _NO_VALIDITY = np.empty((0, 2)), np.empty((0, 6)), np.empty(0, np.bool_)
_MAX_RADTAN_ANGLE_RAD = math.radians(85.0)


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens, packed for the kernels. Build it with one of its static methods.

    Attributes:
        kind: of ``lens_kernels``: PINHOLE, FISHEYE, OMNIDIRECTIONAL or EQUIRECTANGULAR.
        packed: (13,) fx fy cx cy [px], eight distortion coefficients in the order of ``ORDERS``,
            then zeros, and the limit of the injective domain: a normalised radius (pinhole) or a
            field angle [rad] (fisheye, omnidirectional).
    """

    kind: int
    packed: Array

    @staticmethod
    def pinhole(
        *, fx: float, fy: float, cx: float, cy: float, distortion: Sequence[float] = ()
    ) -> Lens:
        """Pinhole with OpenCV's radial-tangential distortion: 0, 4, 5 or 8 coefficients.

        Raises:
            ValueError: on another number of coefficients, or a focal length that is not positive.
        """
        coefficients = _checked(fx, fy, distortion, "pinhole")
        limit = _radtan_limit(tuple(coefficients.tolist()))
        return Lens(PINHOLE, np.array([fx, fy, cx, cy, *coefficients, limit], dtype=np.float64))

    @staticmethod
    def fisheye(*, fx: float, fy: float, cx: float, cy: float, distortion: Sequence[float]) -> Lens:
        """Kannala-Brandt fisheye (OpenCV ``fisheye``, Kalibr and ROS ``equidistant``).

        Raises:
            ValueError: unless there are 4 coefficients and positive focal lengths.
        """
        coefficients = _checked(fx, fy, distortion, "fisheye")
        limit = _fisheye_limit(coefficients)
        return Lens(FISHEYE, np.array([fx, fy, cx, cy, *coefficients, limit], dtype=np.float64))

    @staticmethod
    def omnidirectional(
        *, fx: float, fy: float, cx: float, cy: float, distortion: Sequence[float]
    ) -> Lens:
        """The unified model of Mei (OpenCV ``omnidir``, Kalibr ``omni-radtan``): xi k1 k2 p1 p2.

        Raises:
            ValueError: unless there are 5 coefficients, positive focal lengths and 0 <= xi.
        """
        coefficients = _checked(fx, fy, distortion, "omnidirectional")
        check_mirror(coefficients[0])
        limit = omnidirectional_limit(coefficients)
        return Lens(OMNIDIRECTIONAL, np.array([fx, fy, cx, cy, *coefficients, limit]))

    @staticmethod
    def equirectangular(
        *, fx: float, fy: float, cx: float, cy: float, distortion: Sequence[float] = ()
    ) -> Lens:
        """A panorama: u = fx longitude + cx, v = fy latitude + cy; right and down are positive.

        A whole one of width W has fx = W / (2 pi), and its columns go round.

        Raises:
            ValueError: if there is distortion, or a focal length that is not positive.
        """
        coefficients = _checked(fx, fy, distortion, "equirectangular")
        return Lens(EQUIRECTANGULAR, np.array([fx, fy, cx, cy, *coefficients, math.pi]))

    @property
    def is_undistorted_pinhole(self) -> bool:
        """Whether its pixels are linear in x/z and y/z; it has no limit then."""
        return self.kind == PINHOLE and math.isinf(self.packed[LIMIT])

    @property
    def pixels_per_rad(self) -> float:
        """Resolution along u on the camera's axis [px/rad]."""
        fx = float(self.packed[0])
        return fx / (1.0 + float(self.packed[4])) if self.kind == OMNIDIRECTIONAL else fx

    def subtract(self, pixels_px: Array, others_px: Array) -> Array:
        """(n, 2) differences of pixels; across the seam of a panorama the short way."""
        difference = pixels_px - others_px
        if self.kind == EQUIRECTANGULAR:
            turn = 2.0 * math.pi * self.packed[0]
            difference[:, 0] -= turn * np.floor(difference[:, 0] / turn + 0.5)
        return np.asarray(difference)

    def project(self, points_camera_m: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Project points.

        Args:
            points_camera_m: (n, 3) in the camera frame.

        Returns:
            (n, 2) pixels, and (n,) whether each is a real projection (in front of the camera and
            inside the injective domain of the lens). It may still lie outside the image.
        """
        points = contiguous(np.asarray(points_camera_m, dtype=np.float64).reshape(-1, 3))
        pixels, valid = np.empty((len(points), 2)), np.empty(len(points), np.bool_)
        _project_many(self.kind)(self.packed, points, pixels, valid, _NO_JACOBIANS)
        return pixels, valid

    def are_projectable(self, points_lidar_m: Array, T_camera_lidar: Array) -> NDArray[np.bool_]:
        """(n,) whether (n, 3) points in the LiDAR frame have a real projection, as `project`."""
        points = contiguous(points_lidar_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
        valid = np.empty(len(points), np.bool_)
        _project_many(self.kind)(self.packed, points, _NO_PIXELS, valid, _NO_JACOBIANS)
        return valid

    def project_with_jacobian(self, points_camera_m: ArrayLike) -> tuple[Array, Array]:
        """Project points: (n, 2) pixels, and their (n, 2, 3) derivatives by the points."""
        points = contiguous(np.asarray(points_camera_m, dtype=np.float64).reshape(-1, 3))
        pixels, jacobians = np.empty((len(points), 2)), np.empty((len(points), 6))
        _project_many(self.kind)(self.packed, points, pixels, _NO_VALIDITY, jacobians)
        return pixels, jacobians.reshape(-1, 2, 3)

    def fill_twist_columns(
        self, T_camera_lidar: Array, points_lidar_m: Array, columns: Array
    ) -> Array:
        """Project points in the LiDAR frame, with derivatives by a twist of the camera, by columns.

        Args:
            T_camera_lidar: (4, 4); the twist xi perturbs it as exp(xi) T_camera_lidar.
            points_lidar_m: (n, 3) in the LiDAR frame.
            columns: (6, 2, n), filled: derivatives by rotation [px/rad] and translation [px/m].

        Returns:
            (2, n) pixels.
        """
        points = T_camera_lidar[:3, :3] @ points_lidar_m.T + T_camera_lidar[:3, 3:]
        pixels, by_point = self.project_with_jacobian(points.T)
        columns[3:] = by_point.transpose(2, 1, 0)
        (x, y, z), (by_x, by_y, by_z) = points, columns[3:]
        # d(exp(xi) p) / d rotation = -[p]x;  g^T (-[p]x) = (p x g)^T.
        columns[0] = y * by_z - z * by_y
        columns[1] = z * by_x - x * by_z
        columns[2] = x * by_y - y * by_x
        return pixels.T


def _checked(fx: float, fy: float, distortion: Sequence[float], model: LensModel) -> Array:
    if not (fx > 0 and fy > 0):
        raise ValueError(f"focal lengths must be positive, found fx={fx}, fy={fy}")
    if len(distortion) not in COEFFICIENTS[model]:
        allowed = ", ".join(map(str, COEFFICIENTS[model]))
        raise ValueError(
            f"{len(distortion)} distortion coefficients found, expected {allowed}: {ORDERS[model]}"
        )
    return np.pad(np.asarray(distortion, dtype=np.float64), (0, 8 - len(distortion)))


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
    return min(root, math.tan(_MAX_RADTAN_ANGLE_RAD))


def _fisheye_limit(coefficients: Array) -> float:
    """Field angle at which the distorted angle stops growing, at most just under 180 degrees."""
    slope = np.array([1.0, *(coefficients[:4] * [3.0, 5.0, 7.0, 9.0])])
    return min(math.sqrt(_smallest_positive_root(slope)), math.radians(179.0))


@cache
def _project_many(kind: int) -> Any:
    @compiled()
    def run(lens, points, pixels, valid, jacobians):  # type: ignore[no-untyped-def]
        """Fill in (n, 2) pixels, (n,) validity and (n, 6) derivatives, where there is room."""
        for k in range(len(points)):
            x, y, z = points[k, 0], points[k, 1], points[k, 2]
            if len(valid):
                valid[k] = is_projectable(kind, lens, x, y, z)
            if len(pixels):
                projection = project_one(kind, lens, x, y, z)
                pixels[k, 0], pixels[k, 1] = projection[0], projection[1]
                for place in range(6 if len(jacobians) else 0):
                    jacobians[k, place] = projection[2 + place]

    return run
