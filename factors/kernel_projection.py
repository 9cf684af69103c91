"""The forward pass over a tile: residuals and their derivatives, by the kind of lens.

A tile is a (ROWS, TILE) array: a few hundred correspondences whose intermediate values stay in the
cache. Each row holds one quantity, so that the loops over it vectorize.

Three things would keep the compiler from vectorizing the loops: an index that may be negative, and
an entry that a row may overlap, hence what is taken out before a loop, and Python's exception on a
division by zero, hence ``error_model="numpy"``.
"""

from factors.compiled import compiled
from factors.lens_kernels import MIN_DEPTH_M, project_one, project_radtan, subtract_columns

FAST = {"reassoc", "contract", "nsz", "arcp"}
"""The arithmetic that LLVM may assume; NaN and infinity keep their meaning."""

TILE = 256
"""Correspondences in a tile: its intermediate values fill the first-level cache."""

(RU, RV, UX, UY, UZ, VX, VY, VZ, X, Y, Z, PSI, PRODUCT) = range(13)
"""Rows of a tile: the residual, the derivatives of u and v by the point, the point in the camera
frame, the loss' weight psi, and scratch for products."""
ROWS = 13

ACROSS = PRODUCT
"""The weight of the derivatives across the residual, where PSI has the weight of those along it."""

(A, B, W) = (X, Y, Z)
"""Of an undistorted pinhole, in place of the point: x/z, y/z and 1/z."""

MATRICES = 3
"""Rows of the whitening if it is matrices; 1 if it is numbers, 0 if there is none."""

RAYS = -1
"""In place of a kind of lens: an undistorted pinhole, and no matrices."""


@compiled(part=True, fastmath=FAST)
def project_rays(lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals of an undistorted pinhole, x/z, y/z and 1/z.

    False, if a point is too near for these to hold.
    """
    xs, ys, zs = columns[0][start:], columns[1][start:], columns[2][start:]
    us, vs = columns[3][start:], columns[4][start:]
    ru, rv, ra, rb, rw = tile[RU], tile[RV], tile[A], tile[B], tile[W]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    too_near = 0.0
    for i in range(n):
        px, py, pz = xs[i], ys[i], zs[i]
        z = t20 * px + t21 * py + t22 * pz + t23
        w = 1.0 / z
        a = (t00 * px + t01 * py + t02 * pz + t03) * w
        b = (t10 * px + t11 * py + t12 * pz + t13) * w
        ru[i], rv[i] = fx * a + (cx - us[i]), fy * b + (cy - vs[i])
        ra[i], rb[i], rw[i] = a, b, w
        too_near += 0.0 if z > MIN_DEPTH_M else 1.0
    return too_near == 0.0


@compiled(inline="always")
def project(kind, lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals, their derivatives by the point, and the point in the camera frame."""
    xs, ys, zs = columns[0][start:], columns[1][start:], columns[2][start:]
    us, vs = columns[3][start:], columns[4][start:]
    ru, rv = tile[RU], tile[RV]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    rx, ry, rz = tile[X], tile[Y], tile[Z]
    for i in range(n):
        px, py, pz = xs[i], ys[i], zs[i]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        u, v, ux[i], uy[i], uz[i], vx[i], vy[i], vz[i] = project_one(kind, lens, x, y, z)
        ru[i], rv[i] = subtract_columns(kind, lens, u, us[i]), v - vs[i]
        rx[i], ry[i], rz[i] = x, y, z


@compiled(part=True, fastmath=FAST)
def project_pinhole(lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """``project`` for a pinhole: without branches, if no point lies outside the lens' domain.

    Then the formulas are those of ``lens_kernels._radtan_inside``. False, if a point does.
    """
    xs, ys, zs = columns[0][start:], columns[1][start:], columns[2][start:]
    us, vs = columns[3][start:], columns[4][start:]
    ru, rv = tile[RU], tile[RV]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    rx, ry, rz = tile[X], tile[Y], tile[Z]
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit = (
        lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8], lens[9],
        lens[10], lens[11], lens[12],
    )  # fmt: skip
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    outside = 0.0
    for i in range(n):
        px, py, pz = xs[i], ys[i], zs[i]
        x = t00 * px + t01 * py + t02 * pz + t03
        y = t10 * px + t11 * py + t12 * pz + t13
        z = t20 * px + t21 * py + t22 * pz + t23
        w = 1.0 / z
        a, b = x * w, y * w
        r2 = a * a + b * b
        outside += 0.0 if z > MIN_DEPTH_M and r2 <= limit * limit else 1.0
        over = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) * over
        slope = (
            k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))
        ) * over
        cross = 2.0 * (a * b * slope + p1 * a + p2 * b)
        by_a = radial + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
        by_b = radial + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
        p = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
        q = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
        ru[i], rv[i] = fx * p + (cx - us[i]), fy * q + (cy - vs[i])
        fxw, fyw = fx * w, fy * w
        ux[i], uy[i], uz[i] = fxw * by_a, fxw * cross, -fxw * (by_a * a + cross * b)
        vx[i], vy[i], vz[i] = fyw * cross, fyw * by_b, -fyw * (cross * a + by_b * b)
        rx[i], ry[i], rz[i] = x, y, z
    for i in range(n if outside > 0.0 else 0):
        u, v, ux[i], uy[i], uz[i], vx[i], vy[i], vz[i] = project_radtan(lens, rx[i], ry[i], rz[i])
        ru[i], rv[i] = u - us[i], v - vs[i]
    return outside == 0.0
