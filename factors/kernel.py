"""The compiled passes over correspondences: sums of the block factor, plain residuals, columns.

Points come as columns (structure of arrays). A run of correspondences is cut into tiles: a tile is
a (ROWS, TILE) array of a few hundred correspondences whose intermediate values stay in the cache,
with one quantity in each row, so that the compiler vectorizes the loops over it. Three things would
keep it from that: an index that may be negative, and an entry that a row may overlap, hence what is
taken out before a loop, and Python's exception on a division by zero, hence
``error_model="numpy"``.

There is a kernel per kind of lens, whose number is a constant in it: the branches of other lenses
are not compiled. RAYS is a kind, too, which takes half of the time.

    accumulate   c, or H, b and c by the pose alone: what an optimizer asks for many times
    summarize    the same by the pose and further columns, with the second derivative of the cost:
                 what is asked for at an optimum; or the columns themselves
    evaluate     residuals or their norms

The second derivative of rho(s) / 2 is J^T (psi I + 2 psi' r r^T) J, but for the second derivative
of r. With t = J^T r it is H + sum 2 psi' t t^T.
"""

import math
import warnings
from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numba.core.errors import NumbaWarning

from factors.compiled import compiled, one_at_a_time
from factors.lens_kernels import (
    FISHEYE,
    MIN_DEPTH_M,
    OMNIDIRECTIONAL,
    PINHOLE,
    distort,
    is_projectable,
    project_one,
    project_radtan,
    subtract_columns,
)
from factors.loss import CAUCHY, loss_and_weight, weight_along

# Open3D brings an older libtbb than numba uses; numba then takes another library, as good.
warnings.filterwarnings("ignore", "The TBB threading layer requires", NumbaWarning)

FAST = {"reassoc", "contract", "nsz", "arcp"}
"""The arithmetic that LLVM may assume; NaN and infinity keep their meaning."""

TILE = 256
"""Correspondences in a tile: its intermediate values fill the first-level cache."""

(RU, RV, UX, UY, UZ, VX, VY, VZ, X, Y, Z, PSI, PRODUCT) = range(13)
"""Rows of a tile: the residual, the derivatives of u and v by the point, the point in the camera
frame, the loss' weight psi, and scratch for products."""
ROWS = 13

(A, B, W) = (X, Y, Z)
"""Of an undistorted pinhole, in place of the point: x/z, y/z and 1/z."""

MATRICES = 3
"""Rows of the whitening if it is matrices; 1 if it is numbers, 0 if there is none."""

RAYS = -1
"""In place of a kind of lens: an undistorted pinhole."""

COST, HESSIAN = range(2)
"""Which sums are wanted of :func:`accumulate`: c; or H, b and c."""
SUMS = 28
"""How many that is: 21 of H, 6 of b, 1 of c."""

COLUMNS, PRODUCTS, CURVATURE = range(3)
"""What is wanted of :func:`summarize`: columns; their products; the second derivative, too."""

FOCAL, ASPECT, CENTRE_X, CENTRE_Y, DISPLACED, P1, P2 = range(7)
"""Columns beside the pose: of a lens, or of what displaces the points; the radial coefficient k of
a power is P2 plus the power."""

WIDTH = 2 * TILE + 8
"""Of rows with u and v; those of 4096 bytes would share cache lines."""

_SMALL = 1e-100  # far from the smallest float by more than four factors


@cache
def accumulate(kind: int, *, shared: bool = False) -> Any:
    """The kernel of sums by the pose over runs of correspondences; ``shared``: by all cores."""

    @compiled(fastmath=FAST, parallel=shared)
    def accumulate_runs(lens, poses, columns, whitening, loss, scales, runs, wanted, out):  # type: ignore[no-untyped-def]
        """Fill (r, SUMS) sums over the runs ``runs[i, 0]:runs[i, 1]``.

        ``poses`` (r, 4, 4) are T_camera_lidar and ``scales`` (r,) the loss', each of one run, or
        (1, 4, 4) and (1,) of all; ``columns`` (5, n) are x y z u v; ``whitening`` is (3, n):
        triangular matrices; (1, n): numbers; or (0, n): none. By RAYS, c is NaN for a run with a
        point that is too near: it is another kernel's.
        """
        for i in prange(len(runs)):
            T = poses[np.int64(i) if len(poses) > 1 else 0]
            scale = scales[np.int64(i) if len(scales) > 1 else 0]
            sums, tile = out[i], np.empty((ROWS, TILE))
            for k in range(len(sums)):
                sums[k] = 0.0
            for start in range(runs[i, 0], runs[i, 1], TILE):
                n = runs[i, 1] - start if runs[i, 1] - start < TILE else TILE
                if kind == RAYS:
                    if not project_rays(lens, T, columns, start, n, tile):
                        sums[27] = math.nan
                    scale_residuals(whitening, start, n, tile)
                elif kind == PINHOLE:
                    project_pinhole(lens, T, columns, start, n, tile)
                else:
                    project(kind, lens, T, columns, start, n, tile)
                if kind != RAYS:
                    whiten(whitening, start, n, tile)
                sums[27] += weigh(loss, scale, n, tile)
                if wanted == COST:
                    continue
                if kind == RAYS:
                    apply_weights(whitening, start, n, tile)
                    sum_rays(lens, n, tile, sums)
                    sum_ray_gradients(lens, n, tile, sums)
                else:
                    sum_tile(n, tile, sums)
                    sum_tile_gradients(n, tile, sums)

    return one_at_a_time(accumulate_runs) if shared else accumulate_runs


@cache
def summarize(kind: int) -> Any:
    """The kernel of sums by pose and further columns over runs of correspondences."""

    @compiled(fastmath=FAST)
    def summarize_runs(  # type: ignore[no-untyped-def]
        lens, poses, columns, moves, whitening, loss, scales, runs, free, units, step, wanted, out
    ):
        """Fill products of columns, or the columns.

        The first arguments as of the sums by the pose. ``free`` (k,) are the columns beside the
        pose, in ``units`` (k,); ``moves`` (m, 3, n) are the displacements of the points in the
        LiDAR frame by those that displace them. ``step`` (6 + k,) displaces the residuals by so
        much of the columns, or is empty. ``out`` (1, 7 + k, 2, n): the columns and last the
        residuals; or (r, 1 to 2, 8 + k, 7 + k): of each run H, b in the last column and the sum of
        psi s in the corner, in the upper triangle, and below it c and the sum of psi; then, if
        there is room, - sum 2 psi' t t^T.
        """
        size = 7 + len(free)
        rows, bends = np.empty((size, WIDTH)), np.empty((size, WIDTH))
        weights = np.empty((2, WIDTH))
        for run in range(len(runs)):
            T = poses[run if len(poses) > 1 else 0]
            scale = scales[run if len(scales) > 1 else 0]
            for start in range(runs[run, 0], runs[run, 1], TILE):
                n = min(TILE, runs[run, 1] - start)
                for i in range(n):
                    linearize(
                        kind, lens, T, columns, moves, whitening, start, i, n, free, units, rows
                    )
                if wanted == COLUMNS:
                    for k in range(size):
                        for i in range(n):
                            out[0, k, 0, start + i] = rows[k, i]
                            out[0, k, 1, start + i] = rows[k, n + i]
                    continue
                for k in range(len(step)):
                    add_row(step[k], rows[k], rows[size - 1], 2 * n)
                weigh_columns(loss, scale, n, rows[size - 1], weights, out[run, 0, size])
                if wanted == CURVATURE:
                    for k in range(size):
                        bend(weights, rows[k], rows[size - 1], bends[k], n)
                    add_products(n, bends, out[run, 1])
                for k in range(size):
                    multiply(weights[0], rows[k], 2 * n)
                add_products(2 * n, rows, out[run, 0])

    return summarize_runs


@compiled(inline="always")
def linearize(kind, lens, T, columns, moves, whitening, start, i, n, free, units, rows):  # type: ignore[no-untyped-def]
    """Whitened derivatives of u and v by pose and further columns; last the residuals."""
    at, last = start + i, 6 + len(free)
    x, y, z = turn(T, columns[0, at], columns[1, at], columns[2, at])
    x, y, z = x + T[0, 3], y + T[1, 3], z + T[2, 3]
    pixel_u, pixel_v, ux, uy, uz, vx, vy, vz = project_one(kind, lens, x, y, z)
    rows[0, i], rows[1, i], rows[2, i] = uy * z - uz * y, uz * x - ux * z, ux * y - uy * x
    rows[3, i], rows[4, i], rows[5, i] = -ux, -uy, -uz
    rows[0, n + i], rows[1, n + i], rows[2, n + i] = (
        vy * z - vz * y,
        vz * x - vx * z,
        vx * y - vy * x,
    )
    rows[3, n + i], rows[4, n + i], rows[5, n + i] = -vx, -vy, -vz
    rows[last, i] = subtract_columns(kind, lens, pixel_u, columns[3, at])
    rows[last, n + i] = pixel_v - columns[4, at]
    move, seen, a, b, s, over = 0, False, 0.0, 0.0, 0.0, 1.0
    if len(free) > len(moves):
        seen = is_projectable(kind, lens, x, y, z)
        a, b, s, over = to_plane(kind, lens, x, y, z)
    for k in range(len(free)):
        u = v = 0.0
        if free[k] == DISPLACED:
            ex, ey, ez = turn(T, moves[move, 0, at], moves[move, 1, at], moves[move, 2, at])
            u, v, move = ux * ex + uy * ey + uz * ez, vx * ex + vy * ey + vz * ez, move + 1
        elif seen:
            u, v = by_lens(free[k], lens, a, b, s, over, pixel_u - lens[2], pixel_v - lens[3])
        rows[6 + k, i], rows[6 + k, n + i] = units[k] * u, units[k] * v
    if whitening.shape[0] > 0:
        s00, s01 = whitening[0, at], whitening[1, at] if whitening.shape[0] == MATRICES else 0.0
        s11 = whitening[2, at] if whitening.shape[0] == MATRICES else s00
        for k in range(len(rows)):
            rows[k, i] = s00 * rows[k, i] + s01 * rows[k, n + i]
            rows[k, n + i] *= s11


@compiled(inline="always")
def turn(T, x, y, z):  # type: ignore[no-untyped-def]
    """A vector turned by a pose."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z,
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z,
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z,
    )


@compiled(inline="always")
def to_plane(kind, lens, x, y, z):  # type: ignore[no-untyped-def]
    """The undistorted point, its radius squared, of a fisheye the angle's, and what divides it."""
    over = 1.0
    if kind == FISHEYE:
        radius = math.hypot(x, y)
        scale = math.atan2(radius, z) / max(radius, 1e-300)
    elif kind == OMNIDIRECTIONAL:
        scale = 1.0 / (z + lens[4] * math.sqrt(x * x + y * y + z * z))
    else:
        scale = 1.0 / z
    a, b = x * scale, y * scale
    s = a * a + b * b
    if kind == PINHOLE:
        over = 1.0 / (1.0 + s * (lens[9] + s * (lens[10] + s * lens[11])))
    return a, b, s, over


@compiled(part=True, fastmath=FAST)
def by_lens(number, lens, a, b, s, over, u, v):  # type: ignore[no-untyped-def]
    """Derivatives of a pixel by a parameter of the lens; u, v are from the centre."""
    if number <= ASPECT:
        return (u, v) if number == FOCAL else (0.5 * u, -0.5 * v)
    if number <= CENTRE_Y:
        return (1.0, 0.0) if number == CENTRE_X else (0.0, 1.0)
    if number == P1:
        return lens[0] * 2.0 * a * b, lens[1] * (s + 2.0 * b * b)
    if number == P2:
        return lens[0] * (s + 2.0 * a * a), lens[1] * 2.0 * a * b
    for _ in range(number - P2):
        over *= s
    return lens[0] * a * over, lens[1] * b * over


@compiled(inline="always")
def add_row(size, row, out, n):  # type: ignore[no-untyped-def]
    """Add so much of a row."""
    for i in range(n):
        out[i] += size * row[i]


@compiled(inline="always")
def multiply(factors, row, n):  # type: ignore[no-untyped-def]
    """Multiply each number of a row by its factor."""
    for i in range(n):
        row[i] *= factors[i]


@compiled(inline="always")
def weigh_columns(loss, scale, n, residuals, weights, sums):  # type: ignore[no-untyped-def]
    """Fill in the root of psi, once for u and once for v, and that of -2 psi'; add rho and psi."""
    cost = total = 0.0
    for i in range(n):
        u, v = residuals[i], residuals[n + i]
        s = u * u + v * v
        rho, psi = loss_and_weight(loss, scale, s)
        cost, total = cost + rho, total + psi
        weights[0, i] = weights[0, n + i] = math.sqrt(psi)
        least = s if s > 0.0 else 1.0
        weights[1, i] = math.sqrt(max(psi - weight_along(loss, scale, s, psi), 0.0) / least)
    sums[0] += cost
    sums[1] += total


@compiled(inline="always")
def bend(weights, row, residuals, out, n):  # type: ignore[no-untyped-def]
    """A column's part of J^T r of each correspondence, times the root of -2 psi'."""
    for i in range(n):
        out[i] = weights[1, i] * (row[i] * residuals[i] + row[n + i] * residuals[n + i])


@compiled(part=True, fastmath=FAST)
def add_products(length, rows, out):  # type: ignore[no-untyped-def]
    """Add the products of all pairs of rows to an upper triangle."""
    for i in range(len(rows)):
        first = rows[i]
        for j in range(i, len(rows)):
            second, total = rows[j], 0.0
            for k in range(length):
                total += first[k] * second[k]
            out[i, j] += total


@cache
def evaluate(kind: int, *, shared: bool = False) -> Any:
    """The kernel of the residuals, or their norms, of runs; ``shared``: by all cores."""
    lens_kind = PINHOLE if kind == RAYS else kind

    @compiled(fastmath=FAST, parallel=shared)
    def evaluate_runs(lens, poses, columns, whitening, factor, runs, out, valid):  # type: ignore[no-untyped-def]
        """Fill residuals or norms, and (n,) whether each point is projectable.

        ``lens`` to ``whitening`` and ``runs`` as of the sums; the runs hold every point once.
        ``out`` (n, 2) are the residuals pi - u [px]; or, of a factor > 0, (1 or 2, n) their norms,
        plain and whitened, times the factor, infinite where a point is not projectable.
        """
        for i in prange(len(runs)):
            T, tile = poses[np.int64(i) if len(poses) > 1 else 0], np.empty((ROWS, TILE))
            for start in range(runs[i, 0], runs[i, 1], TILE):
                n = runs[i, 1] - start if runs[i, 1] - start < TILE else TILE
                inside = False
                if kind == RAYS:
                    inside = project_rays(lens, T, columns, start, n, tile)
                elif kind == PINHOLE:
                    inside = project_pinhole(lens, T, columns, start, n, tile)
                if kind != PINHOLE and not inside:
                    project(lens_kind, lens, T, columns, start, n, tile)
                for k in range(n):
                    valid[start + k] = inside or is_projectable(
                        lens_kind, lens, tile[X, k], tile[Y, k], tile[Z, k]
                    )
                if factor > 0.0:
                    fill_norms(whitening, start, n, tile, factor, out)
                    for k in range(0 if inside else n):
                        if not valid[start + k]:
                            for row in range(len(out)):  # a slice compiles for half a second
                                out[row, start + k] = math.inf
                else:
                    for k in range(n):
                        out[start + k, 0], out[start + k, 1] = tile[RU, k], tile[RV, k]

    return one_at_a_time(evaluate_runs) if shared else evaluate_runs


@compiled(inline="always")
def fill_norms(whitening, start, n, tile, factor, norms):  # type: ignore[no-untyped-def]
    """Fill in the norms of a tile's residuals times a factor, plain and whitened."""
    ru, rv = tile[RU], tile[RV]
    plain = norms[0][start:]
    for i in range(n):
        plain[i] = factor * math.sqrt(ru[i] * ru[i] + rv[i] * rv[i])
    if whitening.shape[0] == 0:
        return
    whitened, first = norms[1][start:], whitening[0][start:]
    if whitening.shape[0] < MATRICES:
        for i in range(n):
            whitened[i] = first[i] * plain[i]
        return
    across, second = whitening[1][start:], whitening[2][start:]
    for i in range(n):
        u, v = first[i] * ru[i] + across[i] * rv[i], second[i] * rv[i]
        whitened[i] = factor * math.sqrt(u * u + v * v)


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

    False, if a point does.
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
        p, q, by_a, cross, _, by_b = distort(a, b, k1, k2, p1, p2, k3, k4, k5, k6)
        ru[i], rv[i] = fx * p + (cx - us[i]), fy * q + (cy - vs[i])
        fxw, fyw = fx * w, fy * w
        ux[i], uy[i], uz[i] = fxw * by_a, fxw * cross, -fxw * (by_a * a + cross * b)
        vx[i], vy[i], vz[i] = fyw * cross, fyw * by_b, -fyw * (cross * a + by_b * b)
        rx[i], ry[i], rz[i] = x, y, z
    for i in range(n if outside > 0.0 else 0):
        u, v, ux[i], uy[i], uz[i], vx[i], vy[i], vz[i] = project_radtan(lens, rx[i], ry[i], rz[i])
        ru[i], rv[i] = u - us[i], v - vs[i]
    return outside == 0.0


@compiled(inline="always")
def whiten(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals and derivatives by the whitening matrices, or by numbers."""
    if whitening.shape[0] == 0:
        return
    diagonal = whitening.shape[0] == 1
    for i in range(n):
        s00 = whitening[0, start + i]
        s01 = 0.0 if diagonal else whitening[1, start + i]
        s11 = s00 if diagonal else whitening[2, start + i]
        tile[RU, i] = s00 * tile[RU, i] + s01 * tile[RV, i]
        tile[UX, i] = s00 * tile[UX, i] + s01 * tile[VX, i]
        tile[UY, i] = s00 * tile[UY, i] + s01 * tile[VY, i]
        tile[UZ, i] = s00 * tile[UZ, i] + s01 * tile[VZ, i]
        tile[RV, i] *= s11
        tile[VX, i] *= s11
        tile[VY, i] *= s11
        tile[VZ, i] *= s11


@compiled(inline="always")
def scale_residuals(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals by their weights w, if these are numbers."""
    if whitening.shape[0] == 0:
        return
    ru, rv, weights = tile[RU], tile[RV], whitening[0][start:]
    for i in range(n):
        ru[i] *= weights[i]
        rv[i] *= weights[i]


@compiled(inline="always")
def weigh(loss, scale, n, tile):  # type: ignore[no-untyped-def]
    """Fill in the weights psi; return the sum of rho."""
    ru, rv, psi = tile[RU], tile[RV], tile[PSI]
    if loss != CAUCHY:
        cost = 0.0
        for i in range(n):
            rho, psi[i] = loss_and_weight(loss, scale, ru[i] * ru[i] + rv[i] * rv[i])
            cost += rho
        return cost
    k = 1.0 / (scale * scale)
    for i in range(n):
        psi[i] = 1.0 / (1.0 + k * (ru[i] * ru[i] + rv[i] * rv[i]))
    return -_sum_of_logarithms(psi, n, tile[PRODUCT]) / k


@compiled(inline="always")
def _sum_of_logarithms(values, n, products):  # type: ignore[no-untyped-def]
    """The logarithm of the product of ``n`` values, taken before it leaves the range of a float.

    A multiplication each, most of them vectorized, instead of a logarithm.
    """
    quarter = n // 4
    second, third, fourth = values[quarter:], values[2 * quarter :], values[3 * quarter :]
    for i in range(quarter):
        products[i] = (values[i] * second[i]) * (third[i] * fourth[i])
    logarithms, even, odd = 0.0, 1.0, 1.0  # two, because one would wait for itself
    for i in range(quarter // 2):
        even *= products[2 * i]
        odd *= products[2 * i + 1]
        if even < _SMALL or odd < _SMALL:
            logarithms += math.log(even) + math.log(odd)
            even = odd = 1.0
    if quarter % 2:
        odd *= products[quarter - 1]
    for i in range(4 * quarter, n):
        even *= values[i]
    return logarithms + math.log(even) + math.log(odd)


@compiled(inline="always")
def sum_tile(n, tile, out):  # type: ignore[no-untyped-def]
    """Add the 21 sums of H = J^T psi J of a tile.

    q = X^-1 p has dq / d(rotation, translation) = ([q]x, -I), and g^T [q]x = (g x q)^T. With the
    3x3 matrix m = psi g g^T, summed over u and v, and c = m [q]x, the blocks of H are [q]x^T c, c
    and m, but for signs.
    """
    d00 = d01 = d02 = d11 = d12 = d22 = m00 = m01 = m02 = m11 = m12 = m22 = 0.0
    c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
    rx, ry, rz, rp = tile[X], tile[Y], tile[Z], tile[PSI]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    for i in range(n):
        x, y, z, p = rx[i], ry[i], rz[i], rp[i]
        u0, u1, u2, v0, v1, v2 = ux[i], uy[i], uz[i], vx[i], vy[i], vz[i]
        p0, p1, p2, q0, q1, q2 = p * u0, p * u1, p * u2, p * v0, p * v1, p * v2
        xx, xy, xz = p0 * u0 + q0 * v0, p0 * u1 + q0 * v1, p0 * u2 + q0 * v2
        yy, yz, zz = p1 * u1 + q1 * v1, p1 * u2 + q1 * v2, p2 * u2 + q2 * v2
        # Of the rows of c^T: rotation about an axis, by x, y, z.
        ax, ay, az = xy * z - xz * y, yy * z - yz * y, yz * z - zz * y
        bx, by, bz = xz * x - xx * z, yz * x - xy * z, zz * x - xz * z
        cx, cy, cz = xx * y - xy * x, xy * y - yy * x, xz * y - yz * x
        d00 += ay * z - az * y
        d01 += az * x - ax * z
        d02 += ax * y - ay * x
        d11 += bz * x - bx * z
        d12 += bx * y - by * x
        d22 += cx * y - cy * x
        c00 += ax
        c01 += ay
        c02 += az
        c10 += bx
        c11 += by
        c12 += bz
        c20 += cx
        c21 += cy
        c22 += cz
        m00 += xx
        m01 += xy
        m02 += xz
        m11 += yy
        m12 += yz
        m22 += zz
    sums = (
        d00, d01, d02, -c00, -c01, -c02, d11, d12, -c10, -c11, -c12, d22, -c20, -c21, -c22,
        m00, m01, m02, m11, m12, m22,
    )  # fmt: skip
    for k in range(21):
        out[k] += sums[k]


@compiled(inline="always")
def sum_tile_gradients(n, tile, out):  # type: ignore[no-untyped-def]
    """Add J^T psi r of a tile to the sums, see ``sum_tile``."""
    rx, ry, rz, rp = tile[X], tile[Y], tile[Z], tile[PSI]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    res_u, res_v = tile[RU], tile[RV]
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        pull_u, pull_v = rp[i] * res_u[i], rp[i] * res_v[i]
        g3 = -(pull_u * ux[i] + pull_v * vx[i])
        g4 = -(pull_u * uy[i] + pull_v * vy[i])
        g5 = -(pull_u * uz[i] + pull_v * vz[i])
        x, y, z = rx[i], ry[i], rz[i]
        b0 += g5 * y - g4 * z
        b1 += g3 * z - g5 * x
        b2 += g4 * x - g3 * y
        b3 += g3
        b4 += g4
        b5 += g5
    sums = (b0, b1, b2, b3, b4, b5)
    for k in range(6):
        out[21 + k] += sums[k]


@compiled(inline="always")
def apply_weights(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Turn the residuals w r into psi w^2 r, and psi into psi w^2, if the weights are numbers."""
    ru, rv, psi = tile[RU], tile[RV], tile[PSI]
    if whitening.shape[0] == 0:
        for i in range(n):
            ru[i] *= psi[i]
            rv[i] *= psi[i]
        return
    weights = whitening[0][start:]
    for i in range(n):
        w = weights[i]
        ru[i] *= psi[i] * w
        rv[i] *= psi[i] * w
        psi[i] *= w * w


@compiled(inline="always")
def sum_rays(lens, n, tile, out):  # type: ignore[no-untyped-def]
    """Add the 21 sums of H of a tile of a pinhole, from a = x/z, b = y/z, w = 1/z, psi and psi r.

    The rows of the Jacobian are fx (ab, -A, b, -w, 0, aw) and fy (B, -ab, -a, 0, -w, bw) with
    A = 1 + a^2 and B = 1 + b^2: their 21 products share most of their terms, and the focal lengths
    come in at the end. ``u05``: of the first row's entries 0 and 5, without sign and focal length.
    """
    ray_a, ray_b, ray_w, weight = tile[A], tile[B], tile[W], tile[PSI]
    u00 = v00 = u11 = u01 = v01 = u02 = v02 = u12 = v12 = u22 = v22 = 0.0
    for i in range(n):
        a, b, psi = ray_a[i], ray_b[i], weight[i]
        big_a, big_b, ab = 1.0 + a * a, 1.0 + b * b, a * b
        psi_ab, psi_a, psi_b = psi * ab, psi * big_a, psi * big_b
        u00 += psi_ab * ab
        v00 += psi_b * big_b
        u11 += psi_a * big_a
        u01 += psi_ab * big_a
        v01 += psi_ab * big_b
        u02 += psi_ab * b
        v02 += psi_b * a
        u12 += psi_a * b
        v12 += psi_ab * a
        u22 += psi * b * b
        v22 += psi * a * a
    u03 = v04 = u13 = u05 = v15 = v05 = u15 = v24 = u23 = u33 = u35 = v45 = u55 = v55 = 0.0
    for i in range(n):
        a, b, w, psi = ray_a[i], ray_b[i], ray_w[i], weight[i]
        psi_ab, psi_a, psi_b = psi * a * b, psi * (1.0 + a * a), psi * (1.0 + b * b)
        aw, bw = a * w, b * w
        u03 += psi_ab * w
        v04 += psi_b * w
        u13 += psi_a * w
        u05 += psi_ab * aw
        v15 += psi_ab * bw
        v05 += psi_b * bw
        u15 += psi_a * aw
        v24 += psi * aw
        u23 += psi * bw
        u33 += psi * w * w
        u35 += psi * w * aw
        v45 += psi * w * bw
        u55 += psi * aw * aw
        v55 += psi * bw * bw
    fx, fy = lens[0], lens[1]
    p, q = fx * fx, fy * fy
    sums = (
        p * u00 + q * v00, -p * u01 - q * v01, p * u02 - q * v02, -p * u03, -q * v04,
        p * u05 + q * v05, p * u11 + q * u00, -p * u12 + q * v12, p * u13, q * u03,
        -p * u15 - q * v15, p * u22 + q * v22, -p * u23, q * v24, (p - q) * u03,
        p * u33, 0.0, -p * u35, q * u33, -q * v45, p * u55 + q * v55,
    )  # fmt: skip
    for k in range(21):
        out[k] += sums[k]


@compiled(inline="always")
def sum_ray_gradients(lens, n, tile, out):  # type: ignore[no-untyped-def]
    """Add the gradient of a tile of a pinhole to the sums, see ``sum_rays``."""
    pull_u, pull_v = tile[RU], tile[RV]
    ray_a, ray_b, ray_w = tile[A], tile[B], tile[W]
    fx, fy = lens[0], lens[1]
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        a, b, w, u, v = ray_a[i], ray_b[i], ray_w[i], fx * pull_u[i], fy * pull_v[i]
        both = a * u + b * v
        b0 += b * both + v
        b1 -= a * both + u
        b2 += b * u - a * v
        b3 -= w * u
        b4 -= w * v
        b5 += w * both
    sums = (b0, b1, b2, b3, b4, b5)
    for k in range(6):
        out[21 + k] += sums[k]
