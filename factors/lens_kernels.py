"""The projections of the lens models, as kernels: which kinds there are, and their formulas."""

import math
from typing import Any

from factors.compiled import compiled
from factors.wide_lenses import (
    MIN_POLAR_SHARE,
    project_equirectangular,
    project_omnidirectional,
)

MIN_DEPTH_M = 0.05
"""Points with a smaller z are not projectable by a pinhole."""

PINHOLE, FISHEYE, OMNIDIRECTIONAL, EQUIRECTANGULAR = range(4)
LIMIT = 12
"""Index of the domain's limit in the packed parameters; infinite if a pinhole is undistorted."""


def projection_of(kind: int) -> Any:
    """The kernel (lens, x, y, z) of a kind of lens that projects a point of the camera frame.

    It returns the pixel (u, v) and the rows of its Jacobian by x, y, z. Outside the lens' domain
    the projection is continued: a pinhole's depth is held at ``MIN_DEPTH_M``; past the limiting
    radius the distorted point grows linearly along the ray from the limiting circle; past the
    limiting field angle the distorted angle grows with slope one. The continuation is continuous,
    and bounded for bounded points.
    """
    return (project_radtan, _fisheye, project_omnidirectional, project_equirectangular)[kind]


def domain_of(kind: int) -> Any:
    """The kernel (lens, x, y, z) of whether a point lies inside a lens' injective domain."""
    return (_is_in_cone, _is_in_angle, _is_in_angle, _is_off_the_poles)[kind]


def difference_of(kind: int) -> Any:
    """The kernel (lens, u, other) of the difference of two columns u [px].

    Across the seam of a panorama the short way.
    """
    return _difference_across_seam if kind == EQUIRECTANGULAR else _difference


@compiled(part=True, forceinline=True)
def project_radtan(lens, x, y, z):  # type: ignore[no-untyped-def]
    """A pinhole with its distortion, see :func:`projection_of`."""
    in_front = z > MIN_DEPTH_M
    w = 1.0 / (z if in_front else MIN_DEPTH_M)
    a, b = x * w, y * w
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


@compiled(part=True)
def _radtan(lens, a, b):  # type: ignore[no-untyped-def]
    """Distorted normalised point and its 2x2 Jacobian (row major), continued past the limit."""
    limit = lens[LIMIT]
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


@compiled(part=True)
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


@compiled(part=True)
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


@compiled(part=True)
def _is_in_cone(lens, x, y, z):  # type: ignore[no-untyped-def]
    return (z > MIN_DEPTH_M) & (x * x + y * y <= (lens[LIMIT] * z) ** 2)


@compiled(part=True)
def _is_in_angle(lens, x, y, z):  # type: ignore[no-untyped-def]
    return x * x + y * y + z * z > 0.0 and math.atan2(math.hypot(x, y), z) < lens[LIMIT]


@compiled(part=True)
def _is_off_the_poles(lens, x, y, z):  # type: ignore[no-untyped-def]
    return math.hypot(x, z) > MIN_POLAR_SHARE * abs(y)


@compiled(part=True)
def _difference(lens, u, other):  # type: ignore[no-untyped-def]
    return u - other


@compiled(part=True)
def _difference_across_seam(lens, u, other):  # type: ignore[no-untyped-def]
    turn = 2.0 * math.pi * lens[0]
    return u - other - turn * math.floor((u - other) / turn + 0.5)
