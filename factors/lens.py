"""Lens models: from a point in the camera frame to a pixel, with the derivative.

The formulas are OpenCV's (``projectPoints`` and ``fisheye.projectPoints``) inside the field of
view in which they are one-to-one. Outside (behind the camera, or past the field angle at which
the distortion polynomial folds back) OpenCV returns pixels that mean nothing; here such a point is
reported as invalid, and its projection is continued continuously (see ``project_one``), so that an
optimizer that steps there gets a large, finite error instead of a NaN or a wrong small one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]
LensModel = Literal["pinhole", "fisheye"]

MIN_DEPTH_M = 0.05
"""Points with a smaller z are not projectable by a pinhole."""

PINHOLE, RADTAN, FISHEYE = 0, 1, 2
_COEFFICIENTS: dict[LensModel, tuple[int, ...]] = {"pinhole": (0, 4, 5, 8), "fisheye": (4,)}
ORDERS: dict[LensModel, str] = {
    "pinhole": "[], [k1, k2, p1, p2], [k1, k2, p1, p2, k3] or [k1, k2, p1, p2, k3, k4, k5, k6]",
    "fisheye": "[k1, k2, k3, k4]",
}
"""The distortion coefficients of each model in their order, which is OpenCV's."""
_MAX_RADTAN_ANGLE_RAD = math.radians(85.0)
_LIMIT = 12  # index of the domain's limit in the packed parameters


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens, packed for the kernels. Build it with :meth:`pinhole` or :meth:`fisheye`.

    Attributes:
        kind: PINHOLE, RADTAN or FISHEYE.
        packed: (13,) fx fy cx cy [px], eight distortion coefficients in OpenCV's order
            (k1 k2 p1 p2 k3 k4 k5 k6, or k1 k2 k3 k4 for the fisheye), and the limit of the
            injective domain: a normalised radius (pinhole) or a field angle [rad] (fisheye).
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
        limit = _radtan_limit(coefficients)
        kind = RADTAN if np.any(coefficients) else PINHOLE
        return Lens(kind, np.array([fx, fy, cx, cy, *coefficients, limit], dtype=np.float64))

    @staticmethod
    def fisheye(*, fx: float, fy: float, cx: float, cy: float, distortion: Sequence[float]) -> Lens:
        """Kannala-Brandt fisheye (OpenCV ``fisheye``, Kalibr and ROS ``equidistant``).

        Raises:
            ValueError: unless there are 4 coefficients and positive focal lengths.
        """
        coefficients = _checked(fx, fy, distortion, "fisheye")
        limit = _fisheye_limit(coefficients)
        return Lens(FISHEYE, np.array([fx, fy, cx, cy, *coefficients, limit], dtype=np.float64))

    def project(self, points_camera_m: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Project points.

        Args:
            points_camera_m: (n, 3) in the camera frame.

        Returns:
            (n, 2) pixels, and (n,) whether each is a real projection (in front of the camera and
            inside the injective domain of the lens). It may still lie outside the image.
        """
        points = np.ascontiguousarray(points_camera_m, dtype=np.float64).reshape(-1, 3)
        pixels, valid = _project_many(self.kind, self.packed, points)
        return pixels, valid

    def are_projectable(self, points_lidar_m: Array, T_camera_lidar: Array) -> NDArray[np.bool_]:
        """(n,) whether (n, 3) points in the LiDAR frame have a real projection, as `project`."""
        points = np.ascontiguousarray(points_lidar_m, dtype=np.float64)
        T = np.ascontiguousarray(T_camera_lidar)
        return np.asarray(_are_projectable(self.kind, self.packed, T, points))

    def project_with_jacobian(self, points_camera_m: ArrayLike) -> tuple[Array, Array]:
        """Project points: (n, 2) pixels, and their (n, 2, 3) derivatives by the points."""
        points = np.ascontiguousarray(points_camera_m, dtype=np.float64).reshape(-1, 3)
        pixels, jacobians = _project_many_with_jacobian(self.kind, self.packed, points)
        return pixels, jacobians


def _checked(fx: float, fy: float, distortion: Sequence[float], model: LensModel) -> Array:
    if not (fx > 0 and fy > 0):
        raise ValueError(f"focal lengths must be positive, found fx={fx}, fy={fy}")
    if len(distortion) not in _COEFFICIENTS[model]:
        allowed = ", ".join(map(str, _COEFFICIENTS[model]))
        raise ValueError(
            f"{len(distortion)} distortion coefficients found, expected {allowed}: {ORDERS[model]}"
        )
    return np.pad(np.asarray(distortion, dtype=np.float64), (0, 8 - len(distortion)))


def _smallest_positive_root(polynomial: NDArray[Any]) -> float:
    """Smallest positive real root of a polynomial (coefficients by rising power), else inf."""
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(polynomial, "b"))
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min()) if len(real) else math.inf


def _radtan_limit(coefficients: Array) -> float:
    """Radius at which d/dr [r N(r^2) / D(r^2)] first vanishes or D does; tangential terms apart.

    At most that of a ray 85 degrees off the axis: polynomials are not fitted beyond.
    """
    k1, k2, _, _, k3, k4, k5, k6 = coefficients
    numerator = np.polynomial.Polynomial([1.0, k1, k2, k3])
    denominator = np.polynomial.Polynomial([1.0, k4, k5, k6])
    s = np.polynomial.Polynomial([0.0, 1.0])
    slope = numerator * denominator + 2 * s * (
        numerator.deriv() * denominator - numerator * denominator.deriv()
    )
    root = math.sqrt(min(_smallest_positive_root(p.coef) for p in (slope, denominator)))
    return min(root, math.tan(_MAX_RADTAN_ANGLE_RAD)) if np.any(coefficients) else math.inf


def _fisheye_limit(coefficients: Array) -> float:
    """Field angle at which the distorted angle stops growing, at most just under 180 degrees."""
    slope = np.array([1.0, *(coefficients[:4] * [3.0, 5.0, 7.0, 9.0])])
    return min(math.sqrt(_smallest_positive_root(slope)), math.radians(179.0))


@compiled()
def project_one(kind, lens, x, y, z):  # type: ignore[no-untyped-def]
    """Pixel (u, v) of a point in the camera frame and the rows of its Jacobian by x, y, z.

    Outside the lens' domain the projection is continued: a pinhole's depth is held at
    ``MIN_DEPTH_M``; past the limiting radius the distorted point grows linearly along the ray from
    the limiting circle; past the limiting field angle the distorted angle grows with slope one.
    The continuation is continuous, and bounded for bounded points.
    """
    if kind == FISHEYE:
        return _fisheye(lens, x, y, z)
    in_front = z > MIN_DEPTH_M
    w = 1.0 / (z if in_front else MIN_DEPTH_M)
    a, b = x * w, y * w
    if kind == PINHOLE:
        da_a, da_b, db_a, db_b = 1.0, 0.0, 0.0, 1.0
        p, q = a, b
    else:
        p, q, da_a, da_b, db_a, db_b = _radtan(lens, a, b)
    fx, fy = lens[0], lens[1]
    wz = w if in_front else 0.0
    return (
        fx * p + lens[2],
        fy * q + lens[3],
        fx * da_a * w,
        fx * da_b * w,
        -fx * (da_a * a + da_b * b) * wz,
        fy * db_a * w,
        fy * db_b * w,
        -fy * (db_a * a + db_b * b) * wz,
    )


@compiled()
def _radtan(lens, a, b):  # type: ignore[no-untyped-def]
    """Distorted normalised point and its 2x2 Jacobian (row major), continued past the limit."""
    limit = lens[12]
    r2 = a * a + b * b
    if r2 <= limit * limit:
        return _radtan_inside(lens, a, b)
    r = math.sqrt(r2)
    scale = limit / r
    p, q, pa, pb, qa, qb = _radtan_inside(lens, a * scale, b * scale)
    # F(x) = (r / limit) D(x limit / r):  dF = D n^T / limit + dD (I - n n^T),  n = x / r.
    na, nb = a / r, b / r
    return (
        p / scale,
        q / scale,
        p * na / limit + pa * nb * nb - pb * na * nb,
        p * nb / limit + pb * na * na - pa * na * nb,
        q * na / limit + qa * nb * nb - qb * na * nb,
        q * nb / limit + qb * na * na - qa * na * nb,
    )


@compiled()
def _radtan_inside(lens, a, b):  # type: ignore[no-untyped-def]
    k1, k2, p1, p2, k3 = lens[4], lens[5], lens[6], lens[7], lens[8]
    k4, k5, k6 = lens[9], lens[10], lens[11]
    r2 = a * a + b * b
    over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * over
    slope = (
        k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))
    ) * over
    cross = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    return (
        a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a),
        b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b,
        radial + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a,
        cross,
        cross,
        radial + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a,
    )


@compiled()
def _fisheye(lens, x, y, z):  # type: ignore[no-untyped-def]
    """Kannala-Brandt; the angle from atan2, so that fields of view over 180 degrees are seen."""
    fx, fy = lens[0], lens[1]
    rho2 = x * x + y * y
    rho = math.sqrt(rho2)
    if rho < 1e-12 * (abs(z) + 1e-300):
        if z >= 0.0:  # on the axis: the limit of the formulas below
            w = 1.0 / max(z, MIN_DEPTH_M)
            return lens[2], lens[3], fx * w, 0.0, 0.0, 0.0, fy * w, 0.0
        x = rho = 1e-9 * -z  # right behind, every direction is as good: take +x
        y, rho2 = 0.0, rho * rho
    theta = math.atan2(rho, z)
    inside = min(theta, lens[12])
    t2 = inside * inside
    distorted = inside * (1.0 + t2 * (lens[4] + t2 * (lens[5] + t2 * (lens[6] + t2 * lens[7]))))
    slope = 1.0 + t2 * (
        3.0 * lens[4] + t2 * (5.0 * lens[5] + t2 * (7.0 * lens[6] + t2 * 9.0 * lens[7]))
    )
    if theta > inside:
        distorted += theta - inside
        slope = 1.0
    scale = distorted / rho
    n2 = rho2 + z * z
    along = slope * z / (rho2 * n2) - scale / rho2  # d scale / dx = along * x
    wz = -slope / n2
    return (
        fx * x * scale + lens[2],
        fy * y * scale + lens[3],
        fx * (scale + x * x * along),
        fx * x * y * along,
        fx * x * wz,
        fy * x * y * along,
        fy * (scale + y * y * along),
        fy * y * wz,
    )


@compiled()
def is_projectable(kind, lens, x, y, z):  # type: ignore[no-untyped-def]
    """Whether a point of the camera frame lies inside the lens' injective domain."""
    if kind == FISHEYE:
        return x * x + y * y + z * z > 0.0 and math.atan2(math.hypot(x, y), z) < lens[_LIMIT]
    return z > MIN_DEPTH_M and x * x + y * y <= (lens[_LIMIT] * z) ** 2


@compiled(nogil=True)
def _are_projectable(kind, lens, T, points):  # type: ignore[no-untyped-def]
    valid = np.empty(len(points), dtype=np.bool_)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        valid[i] = is_projectable(kind, lens, x, y, z)
    return valid


@compiled(nogil=True)
def _project_many(kind, lens, points):  # type: ignore[no-untyped-def]
    pixels, valid = np.empty((len(points), 2)), np.empty(len(points), dtype=np.bool_)
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        projection = project_one(kind, lens, x, y, z)
        pixels[k, 0], pixels[k, 1] = projection[0], projection[1]
        valid[k] = is_projectable(kind, lens, x, y, z)
    return pixels, valid


@compiled(nogil=True)
def _project_many_with_jacobian(kind, lens, points):  # type: ignore[no-untyped-def]
    n = len(points)
    pixels = np.empty((n, 2))
    jacobians = np.empty((n, 2, 3))
    for k in range(n):
        projection = project_one(kind, lens, points[k, 0], points[k, 1], points[k, 2])
        pixels[k, 0], pixels[k, 1] = projection[0], projection[1]
        jacobians[k, 0, 0], jacobians[k, 0, 1], jacobians[k, 0, 2] = projection[2:5]
        jacobians[k, 1, 0], jacobians[k, 1, 1], jacobians[k, 1, 2] = projection[5:8]
    return pixels, jacobians
