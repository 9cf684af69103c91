"""Lenses that see all round: the unified (Mei) model of omnidirectional cameras, and panoramas.

Mei and Rives, "Single View Point Omnidirectional Camera Calibration from Planar Grids", ICRA 2007:
a point goes to the unit sphere, from there to the plane z = 1 seen from xi behind the sphere's
centre, and is distorted there as by a pinhole's lens. OpenCV's ``omnidir`` and Kalibr's ``omni``
are the same.
"""

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]

MAX_PLANE_RADIUS = math.tan(math.radians(85.0))
"""On the plane of the unified model, as of a pinhole: polynomials are not fitted beyond."""
MIN_POLAR_SHARE = 1e-6
"""Sine of the angle from a panorama's poles within which it has no longitude."""
_TABLE = 500
_MAX_XI = 100.0  # beyond, the model is a parallel projection, whose focal length is not determined


def check_mirror(xi: float) -> None:
    """Check the unified model's xi: 0 is a pinhole, 1 a parabolic mirror, more a fisheye.

    Raises:
        ValueError: if it is negative or far too large.
    """
    if not 0 <= xi <= _MAX_XI:
        raise ValueError(f"xi of the unified model is {xi:g}, expected 0 to {_MAX_XI:g}")


def omnidirectional_limit(coefficients: Array) -> float:
    """Field angle [rad] up to which the unified model is one-to-one, without tangential terms.

    At the least of the angles at which the plane's radius stops growing (arccos(-1 / xi), xi > 1),
    at which the polynomial does, and at which the radius equals a pinhole's at 85 degrees.
    """
    xi, k1, k2 = coefficients[:3]
    roots = np.polynomial.polynomial.polyroots(
        np.trim_zeros(np.array([1.0, 3.0 * k1, 5.0 * k2]), "b")
    )
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]  # noqa: PLR2004
    radius = min([MAX_PLANE_RADIUS, *np.sqrt(real).tolist()])
    # sin(t) / (cos(t) + xi) = radius:  sin(t - atan(radius)) = xi radius / sqrt(1 + radius^2).
    sine = xi * radius / math.hypot(1.0, radius)
    if sine >= 1.0:
        return math.acos(-1.0 / xi)
    return math.atan(radius) + math.asin(sine)


def first_omnidirectional_rays(packed: Array, points: Array) -> Array:
    """(n, 3) unit rays of points (n, 2) on the plane, but for the tangential distortion.

    Args:
        packed: parameters of the lens.
        points: distorted, in focal lengths from the principal point.
    """
    xi, k1, k2 = packed[4:7]
    angle = np.linspace(0.0, packed[12], _TABLE)
    radius = np.sin(angle) / (np.cos(angle) + xi)
    found = np.interp(np.hypot(*points.T), radius * (1 + radius**2 * (k1 + radius**2 * k2)), angle)
    sideways = np.sin(found) / np.maximum(np.hypot(*points.T), np.finfo(float).tiny)
    return np.column_stack([points * sideways[:, None], np.cos(found)])


def equirectangular_rays(angles_rad: Array) -> Array:
    """(n, 3) unit rays of angles (n, 2) to the right and down."""
    right, down = angles_rad.T
    flat = np.cos(down)
    return np.column_stack([np.sin(right) * flat, np.sin(down), np.cos(right) * flat])


@compiled(part=True)
def project_equirectangular(lens, x, y, z):  # type: ignore[no-untyped-def]
    """Longitude and latitude times fx and fy, see ``lens_kernels.projection_of``."""
    fx, fy = lens[0], lens[1]
    n2 = x * x + y * y + z * z
    # At the poles there is no longitude: the derivative is held, so that it is finite.
    flat = max(math.sqrt(x * x + z * z), MIN_POLAR_SHARE * math.sqrt(n2), 1e-12)
    n2 = max(n2, 1e-24)
    f2 = flat * flat
    return (
        fx * math.atan2(x, z) + lens[2],
        fy * math.atan2(y, flat) + lens[3],
        fx * z / f2,
        0.0,
        -fx * x / f2,
        -fy * x * y / (n2 * flat),
        fy * flat / n2,
        -fy * y * z / (n2 * flat),
    )


@compiled(part=True)
def _distort(lens, a, b):  # type: ignore[no-untyped-def]
    """Distorted point of the plane, and its Jacobian (row major)."""
    k1, k2, p1, p2 = lens[5], lens[6], lens[7], lens[8]
    r2 = a * a + b * b
    radial, slope = 1.0 + r2 * (k1 + r2 * k2), k1 + 2.0 * k2 * r2
    cross = 2.0 * (a * b * slope + p1 * a + p2 * b)
    return (
        a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a),
        b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b,
        radial + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a,
        cross,
        cross,
        radial + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a,
    )


@compiled(part=True)
def project_omnidirectional(lens, x, y, z):  # type: ignore[no-untyped-def]
    """The unified model with its Jacobian, see ``lens_kernels.projection_of``.

    Past the limiting field angle t0 the pixel moves on outwards from the limiting circle, in
    proportion to 1 + t - t0, so that it stays finite and continuous right to behind the camera.
    """
    rho2 = x * x + y * y
    rho, n = math.sqrt(rho2), math.sqrt(rho2 + z * z)
    theta = math.atan2(rho, z)
    if theta >= lens[12]:
        return _continue_omnidirectional(lens, x, y, z, theta)
    xi = lens[4]
    w = 1.0 / max(z + xi * n, 1e-9)
    a, b = x * w, y * w
    p, q, pa, pb, qa, qb = _distort(lens, a, b)
    over = xi / max(n, 1e-12)
    wx, wy, wz = -w * x * over, -w * y * over, -w * (1.0 + z * over)  # derivatives of w, over w
    fx, fy = lens[0] * w, lens[1] * w
    by_w_p, by_w_q = pa * x + pb * y, qa * x + qb * y
    return (
        lens[0] * p + lens[2],
        lens[1] * q + lens[3],
        fx * (pa + by_w_p * wx),
        fx * (pb + by_w_p * wy),
        fx * by_w_p * wz,
        fy * (qa + by_w_q * wx),
        fy * (qb + by_w_q * wy),
        fy * by_w_q * wz,
    )


@compiled(part=True)
def _continue_omnidirectional(lens, x, y, z, theta):  # type: ignore[no-untyped-def]
    limit = lens[12]
    radius = math.sin(limit) / (math.cos(limit) + lens[4])
    rho = math.hypot(x, y)
    if rho < 1e-12 * (abs(z) + 1e-300):  # right behind, every direction is as good: take +x
        x, y = 1e-9 * max(abs(z), 1e-3), 0.0
        rho = x
    na, nb = x / rho, y / rho
    p, q, pa, pb, qa, qb = _distort(lens, radius * na, radius * nb)
    grown = 1.0 + theta - limit
    n2 = rho * rho + z * z
    out, back = z / n2, -rho / n2  # derivatives of theta by rho and by z
    turn = radius * grown / rho
    pn, qn = turn * (pa * -nb + pb * na), turn * (qa * -nb + qb * na)  # along the circle
    fx, fy = lens[0], lens[1]
    return (
        fx * p * grown + lens[2],
        fy * q * grown + lens[3],
        fx * (p * out * na - pn * nb),
        fx * (p * out * nb + pn * na),
        fx * p * back,
        fy * (q * out * na - qn * nb),
        fy * (q * out * nb + qn * na),
        fy * q * back,
    )
