"""The projections of the lens models, as kernels: which kinds there are, and their formulas.

Omnidirectional cameras have the unified model of Mei and Rives, "Single View Point Omnidirectional
Camera Calibration from Planar Grids", ICRA 2007: a point goes to the unit sphere, from there to the
plane z = 1 seen from xi behind the sphere's centre, and is distorted there as by a pinhole's lens.
OpenCV's ``omnidir`` and Kalibr's ``omni`` are the same.
"""

import math

from factors.compiled import compiled

MIN_DEPTH_M = 0.05
"""Points with a smaller z are not projectable by a pinhole."""

PINHOLE, FISHEYE, OMNIDIRECTIONAL = range(3)
LIMIT = 12
"""Index of the domain's limit in the packed parameters; infinite if a pinhole is undistorted."""


@compiled(inline="always")
def project_one(kind, lens, x, y, z):  # type: ignore[no-untyped-def]
    """Pixel (u, v) of a point in the camera frame and the rows of its Jacobian by x, y, z.

    Outside the lens' domain the projection is continued: a pinhole's depth is held at
    ``MIN_DEPTH_M``; past the limiting radius the distorted point grows linearly along the ray from
    the limiting circle; past the limiting field angle the distorted angle grows with slope one.
    The continuation is continuous, and bounded for bounded points.

    This and the functions of a kind below become parts of the kernel that calls them. If the kind
    is a constant there, only its own branch is compiled.
    """
    if kind == FISHEYE:
        return _fisheye(lens, x, y, z)
    if kind == OMNIDIRECTIONAL:
        return _omnidirectional(lens, x, y, z)
    return project_radtan(lens, x, y, z)


@compiled(part=True, forceinline=True)
def project_radtan(lens, x, y, z):  # type: ignore[no-untyped-def]
    """A pinhole with its distortion, see :func:`project_one`."""
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
    return distort(a, b, lens[4], lens[5], lens[6], lens[7], lens[8], lens[9], lens[10], lens[11])


@compiled(part=True, forceinline=True)
def distort(a, b, k1, k2, p1, p2, k3, k4, k5, k6):  # type: ignore[no-untyped-def]
    """Radial-tangential distortion of a point of the plane, and its Jacobian (row major)."""
    r2 = a * a + b * b
    over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * over
    slope = (
        k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))
    ) * over
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
def _omnidirectional(lens, x, y, z):  # type: ignore[no-untyped-def]
    """The unified model with its Jacobian, see ``project_one``.

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
    p, q, pa, pb, qa, qb = _distort_mirror(lens, a, b)
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
    p, q, pa, pb, qa, qb = _distort_mirror(lens, radius * na, radius * nb)
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


@compiled(part=True)
def _distort_mirror(lens, a, b):  # type: ignore[no-untyped-def]
    return distort(a, b, lens[5], lens[6], lens[7], lens[8], 0.0, 0.0, 0.0, 0.0)


@compiled(inline="always")
def is_projectable(kind, lens, x, y, z):  # type: ignore[no-untyped-def]
    """Whether a point of the camera frame lies inside the lens' injective domain."""
    if kind in (FISHEYE, OMNIDIRECTIONAL):
        return x * x + y * y + z * z > 0.0 and math.atan2(math.hypot(x, y), z) < lens[LIMIT]
    return (z > MIN_DEPTH_M) & (x * x + y * y <= (lens[LIMIT] * z) ** 2)
