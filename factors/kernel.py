"""The compiled pass over correspondences: sums of the block factor, residuals, columns, fits.

Points come as columns (structure of arrays). A run of correspondences is cut into tiles of a few
hundred, whose intermediate values stay in the cache, with one quantity in each row, so that the
compiler vectorizes the loops over it. Three things would keep it from that: an index that may be
negative, hence those without a sign, an entry that a row may overlap, hence what is taken out
before a loop, and Python's exception on a division by zero, hence ``error_model="numpy"``.

There is one kernel per kind of lens, whose number is a constant in it: the branches of other lenses
are not compiled. Sums by the pose alone are made of the derivatives by the point, in half the time
of rows of derivatives by the pose.

The loss is Cauchy's, rho(s) = k log(1 + s / k) with the square k of a scale, and psi = rho' is
1 / (1 + s / k); of an infinite scale it is s. The second derivative of rho(s) / 2 is
J^T (psi I + 2 psi' r r^T) J, but for the second derivative of r; psi' is - psi^2 / k. With
t = J^T r it is H + sum 2 psi' t t^T.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors.arrays import contiguous, read_only
from factors.compiled import compiled
from factors.lens_kernels import (
    FISHEYE,
    LIMIT,
    MIN_DEPTH_M,
    OMNIDIRECTIONAL,
    PINHOLE,
    distort,
    is_projectable,
    project_one,
)
from factors.pose_kernel import DAMPING, MAX_DAMPING, MAX_STEPS, judge, move, solve_damped

Array = NDArray[np.float64]

FAST = {"reassoc", "contract", "nsz", "arcp"}
"""The arithmetic that LLVM may assume; NaN and infinity keep their meaning."""

TILE = 256
"""Correspondences in a tile: its intermediate values fill the first-level cache."""

(RU, RV, UX, UY, UZ, VX, VY, VZ, X, Y, Z, PSI) = range(12)
"""Rows of a tile: the residual, the derivatives of u and v by the point, the point in the camera
frame, and the loss' weight psi."""
ROWS = 12
OTHER = PSI
"""Of points for which the formulas without branches do not hold 1, before there is a psi."""

MATRICES = 3
"""Rows of the whitening if it is matrices; 1 if it is numbers, 0 if there is none."""

RESIDUALS, NORMS, COLUMNS, COST, PRODUCTS, CURVATURE = range(6)
"""What is wanted: residuals; their norms; columns; c alone; products of the columns, H and b; the
second derivative, too."""

FOCAL, ASPECT, CENTRE_X, CENTRE_Y, DISPLACED, P1, P2 = range(7)
"""Columns beside the pose: of a lens, or of what displaces the points; the radial coefficient k of
a power is P2 plus the power."""

WIDTH = 2 * TILE + 8
"""Of rows with u and then v; those of 4096 bytes would share cache lines."""

NO_STEP = read_only(np.empty(0))
NO_FREE = read_only(np.empty(0, np.int64)), NO_STEP, read_only(np.empty((0, 3, 0)))
_NO_WHITENING = read_only(np.empty((0, 0)))
_NO_FLAGS = np.empty(0, np.bool_)
ON_AXIS = 1e-20  # squared sine of a field angle
MIN_RANGE_M = 1e-9  # what divides a point of the unified model
_SMALL = 1e-100  # far from the smallest float by more than four factors


def pass_over(  # noqa: PLR0913 - the arguments of the kernel
    kind: int,
    lens: Array,
    T_camera_lidar: Array,
    columns: Array,
    wanted: int,
    out: Array,
    *,
    runs: NDArray[np.int64] | None = None,
    whitening: Array = _NO_WHITENING,
    scale: float = 1.0,
    scales: Array = NO_STEP,
    sigma: float = 1.0,
    free: tuple[NDArray[np.int64], Array, Array] = NO_FREE,
    step: Array = NO_STEP,
    tolerance: float = -1.0,
    flags: NDArray[np.bool_] = _NO_FLAGS,
) -> None:
    """Fill ``out`` with what is wanted of each of (r, 2) runs of correspondences.

    Args:
        kind: of the lens.
        lens: (13,) its parameters.
        T_camera_lidar: (r, 4, 4) of each run, or (1, 4, 4). A fit fills in, in place of each, the
            pose at which the cost of the run is least, and gives the sums there.
        columns: (5 or more, n) x y z u v.
        wanted: RESIDUALS to CURVATURE.
        out: (n, 2) residuals pi - u [px]; (1 or 2, n) their norms, plain and whitened, infinite
            where a point is not projectable; (7 + k, 2, n) whitened columns and last the
            residuals; or zeros (r, 1 to 2, 8 + k, 7 + k) for the sums: of each run H, b in the last
            column and the sum of psi s in the corner; below, c and the sum of psi;
            then, if there is room, - sum 2 psi' t t^T.
        runs: first correspondence, and the one behind the last; None: one run. Of residuals and
            norms, they hold every point once.
        whitening: (3, n) triangular matrices, (1, n) numbers, or (0, n).
        scale: of the loss, a multiple of sigma.
        scales: (r,) of each run, in its place; or empty.
        sigma: what whitened residuals are divided by.
        free: (k,) columns beside the pose, (k,) their units, and (m, 3, n) the displacements of the
            points in the LiDAR frame by those that displace them.
        step: (6 + k,) displaces the residuals by so much of the columns; or empty.
        tolerance: relative decrease of the cost at which a fit is done; negative: no fit.
        flags: (n,) is filled with whether each point is projectable; of a fit, (r,) whether it
            ended by the tolerance.
    """
    if runs is None:
        runs = np.array([[0, columns.shape[1]]])
    poses = T_camera_lidar if tolerance >= 0 else np.array(T_camera_lidar, order="C")
    _kernel(kind)(
        lens, poses, columns, whitening, contiguous(runs), scale, scales, sigma, *free, step,
        wanted, tolerance, out.reshape((1,) * (4 - out.ndim) + out.shape), flags,
    )  # fmt: skip


@cache
def _kernel(kind: int) -> Any:
    @compiled(fastmath=FAST)
    def pass_over_runs(  # type: ignore[no-untyped-def]
        lens, poses, columns, whitening, runs, scale, scales, sigma, free, units, moves, step,
        wanted, tolerance, out, flags,
    ):  # fmt: skip
        """See ``pass_over``; ``out`` has four axes."""
        size, fits = 7 + len(free), tolerance >= 0.0
        rows, bends, tile = np.empty((size, WIDTH)), np.empty((size, TILE)), np.empty((ROWS, TILE))
        tried, sums, work = np.empty((2, 4, 4)), np.empty((2, size + 1, size)), np.empty((7, 6))
        by_pose = COST <= wanted <= PRODUCTS and size == 7 and len(step) == 0  # noqa: PLR2004
        for run in range(len(runs)):
            best, new = np.int64(0), np.int64(0)  # for a literal, parts would be compiled twice
            damping, is_done = DAMPING, False
            width = sigma * (scales[run] if len(scales) else scale)
            copy(poses[run if len(poses) > 1 else 0], tried[0])
            for trial in range(1 + MAX_STEPS if fits else 1):
                T, found = tried[new], out[run if wanted >= COST else 0, 0]
                found = sums[new] if fits else found
                for i in range(size + 1 if fits else 0):
                    for k in range(size):
                        found[i, k] = 0.0
                for start in range(runs[run, 0], runs[run, 1], TILE):
                    n = min(TILE, runs[run, 1] - start)
                    to_camera(T, columns, start, n, tile)
                    if kind == PINHOLE:
                        inside = project_pinhole(lens, columns, start, n, tile)
                        if wanted >= COLUMNS and wanted != COST:
                            differentiate_pinhole(lens, n, tile)
                    elif kind == FISHEYE:
                        inside = project_fisheye(lens, columns, start, n, tile)
                    else:
                        inside = project_omnidirectional(lens, columns, start, n, tile)
                    if not inside:
                        project_others(kind, lens, columns, start, n, tile)
                    if wanted < COLUMNS:
                        for k in range(n if inside else 0):
                            flags[np.uint64(start + k)] = True
                        for k in range(0 if inside else n):
                            flags[start + k] = tile[OTHER, k] == 0.0 or is_projectable(
                                kind, lens, tile[X, k], tile[Y, k], tile[Z, k]
                            )
                        for k in range(n if wanted == RESIDUALS else 0):
                            out[0, 0, start + k, 0] = tile[RU, k]
                            out[0, 0, start + k, 1] = tile[RV, k]
                        if wanted == NORMS:
                            fill_norms(whitening, start, n, tile, flags, out[0, 0])
                        continue
                    if by_pose:
                        if len(whitening):
                            whiten(whitening, start, n, tile[RU], tile[RV])
                            for k in range(3 if wanted != COST else 0):
                                whiten(whitening, start, n, tile[UX + k], tile[VX + k])
                        found[7, 0] += weigh(width, n, tile[RU], tile[RV], tile[PSI])
                        if wanted != COST:
                            add_by_pose(n, tile, found)
                        continue
                    fill_rows(n, tile, rows)
                    if len(free):
                        fill_columns(
                            kind, lens, T, columns, moves, start, n, free, units, tile, rows
                        )
                    if len(whitening):
                        for k in range(size):
                            whiten(whitening, start, n, rows[k], rows[k, n:])
                    if wanted == COLUMNS:
                        for k in range(size):
                            for i in range(n):
                                out[0, k, 0, start + i] = rows[k, i] / sigma
                                out[0, k, 1, start + i] = rows[k, n + i] / sigma
                        continue
                    residuals = rows[size - 1]
                    for k in range(len(step)):
                        for i in range(2 * n):
                            residuals[i] += step[k] * rows[k, i]
                    psi = tile[PSI]
                    found[size, 0] += weigh(width, n, residuals, residuals[n:], psi)
                    if wanted == CURVATURE:
                        fill_bends(width, n, psi, rows, bends)
                        add_products(n, bends, out[run, 1])
                    if wanted != COST:
                        add_weighted(n, psi, rows, found)
                if not fits:
                    break
                if trial > 0:
                    best, damping, is_done = judge(sums, best, work, damping, tolerance)
                flags[run] = is_done and damping < MAX_DAMPING
                if is_done:
                    break
                new = 1 - best
                solve_damped(sums[best], damping, work)
                move(-1.0, work[6], tried[best], tried[new])
            if fits:
                copy(tried[best], poses[run])
                copy(sums[best], out[run, 0])
            if wanted >= COST:
                for part in range(out.shape[1]):
                    complete(sigma, out[run, part])

    return pass_over_runs


@compiled(part=True)
def copy(of, to):  # type: ignore[no-untyped-def]
    """Copy a matrix; an assignment to a slice compiles for half a second."""
    for i in range(len(of)):
        for k in range(of.shape[1]):
            to[i, k] = of[i, k]


@compiled(part=True, fastmath=FAST)
def fill_rows(n, tile, rows):  # type: ignore[no-untyped-def]
    """Derivatives of u and v by the pose, and last the residuals.

    q = X^-1 p has dq / d(rotation, translation) = ([q]x, -I), and g^T [q]x = (g x q)^T.
    """
    for axis in range(2):
        gx, gy, gz = tile[UX + 3 * axis], tile[UY + 3 * axis], tile[UZ + 3 * axis]
        for i in range(n):
            x, y, z, at = tile[X, i], tile[Y, i], tile[Z, i], np.uint64(axis * n + i)
            rows[0, at], rows[1, at] = gy[i] * z - gz[i] * y, gz[i] * x - gx[i] * z
            rows[2, at] = gx[i] * y - gy[i] * x
            rows[3, at], rows[4, at], rows[5, at] = -gx[i], -gy[i], -gz[i]
    residuals = rows[len(rows) - 1]
    for i in range(n):
        residuals[i], residuals[np.uint64(n + i)] = tile[RU, i], tile[RV, i]


@compiled(part=True, fastmath=FAST)
def fill_columns(kind, lens, T, columns, moves, start, n, free, units, tile, rows):  # type: ignore[no-untyped-def]
    """Derivatives of u and v by the columns beside the pose."""
    for i in range(n):
        at, move, seen, a, b, s, over = start + i, 0, False, 0.0, 0.0, 0.0, 1.0
        if len(free) > len(moves):
            x, y, z = tile[X, i], tile[Y, i], tile[Z, i]
            seen = is_projectable(kind, lens, x, y, z)
            a, b, s, over = to_plane(kind, lens, x, y, z)
        for k in range(len(free)):
            u = v = 0.0
            if free[k] == DISPLACED:
                px, py, pz = moves[move, 0, at], moves[move, 1, at], moves[move, 2, at]
                ex = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz
                ey = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz
                ez = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz
                u = tile[UX, i] * ex + tile[UY, i] * ey + tile[UZ, i] * ez
                v = tile[VX, i] * ex + tile[VY, i] * ey + tile[VZ, i] * ez
                move += 1
            elif seen:
                u, v = (
                    tile[RU, i] + columns[3, at] - lens[2],
                    tile[RV, i] + columns[4, at] - lens[3],
                )
                u, v = by_lens(free[k], lens, a, b, s, over, u, v)
            rows[6 + k, i], rows[6 + k, n + i] = units[k] * u, units[k] * v


@compiled(part=True)
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


@compiled(part=True, fastmath=FAST)
def fill_bends(scale, n, psi, rows, bends):  # type: ignore[no-untyped-def]
    """Each column's part of J^T r, times the root of -2 psi'."""
    residuals, root = rows[len(rows) - 1], math.sqrt(2.0) / scale
    ru, rv = residuals, residuals[n:]
    for k in range(len(rows)):
        for i in range(n):
            along = rows[k, i] * ru[i] + rows[k, np.uint64(n + i)] * rv[i]
            bends[k, i] = root * psi[i] * along


@compiled(part=True, fastmath=FAST)
def add_weighted(n, psi, rows, sums):  # type: ignore[no-untyped-def]
    """Add the products of rows, weighted, and the weights."""
    total = 0.0
    for i in range(n):
        total += psi[i]
        psi[i] = math.sqrt(psi[i])
    sums[len(rows), 1] += total
    for k in range(len(rows)):
        for i in range(n):
            rows[k, i] *= psi[i]
            rows[k, np.uint64(n + i)] *= psi[i]
    add_products(2 * n, rows, sums)


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


@compiled(part=True, fastmath=FAST)
def whiten(whitening, start, n, u, v):  # type: ignore[no-untyped-def]
    """Multiply a row of u and one of v by the whitening matrices, or by numbers."""
    for i in range(n):
        at = np.uint64(start + i)
        if len(whitening) == MATRICES:
            u[i] = whitening[0, at] * u[i] + whitening[1, at] * v[i]
            v[i] *= whitening[2, at]
        else:
            u[i] *= whitening[0, at]
            v[i] *= whitening[0, at]


@compiled(part=True, fastmath=FAST)
def weigh(scale, n, ru, rv, psi):  # type: ignore[no-untyped-def]
    """Fill in the weights psi; return the sum of rho.

    That is the logarithm of a product, taken before it leaves the range of a float; of an infinite
    scale, the sum of squares.
    """
    k = 1.0 / (scale * scale)
    for i in range(n):
        psi[i] = 1.0 / (1.0 + k * (ru[i] * ru[i] + rv[i] * rv[i]))
    if k == 0.0:
        squares = 0.0
        for i in range(n):
            squares += ru[i] * ru[i] + rv[i] * rv[i]
        return squares
    logarithms, a, b, c, d = 0.0, 1.0, 1.0, 1.0, 1.0  # four, because one would wait for itself
    for i in range(n // 4):
        a *= psi[4 * i]
        b *= psi[4 * i + 1]
        c *= psi[4 * i + 2]
        d *= psi[4 * i + 3]
        if a < _SMALL or b < _SMALL or c < _SMALL or d < _SMALL:
            logarithms += math.log(a) + math.log(b) + math.log(c) + math.log(d)
            a = b = c = d = 1.0
    for i in range(n - n % 4, n):
        a *= psi[i]
    return -(logarithms + math.log(a) + math.log(b) + math.log(c) + math.log(d)) / k


@compiled(part=True, fastmath=FAST)
def fill_norms(whitening, start, n, tile, seen, norms):  # type: ignore[no-untyped-def]
    """Fill in the norms of a tile's residuals, plain and whitened."""
    ru, rv = tile[RU], tile[RV]
    for i in range(n):
        norms[0, np.uint64(start + i)] = math.sqrt(ru[i] * ru[i] + rv[i] * rv[i])
    for i in range(n if len(whitening) else 0):
        at = np.uint64(start + i)
        if len(whitening) < MATRICES:
            norms[1, at] = whitening[0, at] * norms[0, at]
        else:
            u = whitening[0, at] * ru[i] + whitening[1, at] * rv[i]
            v = whitening[2, at] * rv[i]
            norms[1, at] = math.sqrt(u * u + v * v)
    for i in range(start, start + n):
        if not seen[i]:
            for row in range(len(norms)):  # a slice compiles for half a second
                norms[row, i] = math.inf


@compiled(part=True, fastmath=FAST)
def to_camera(T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Fill in the points in the camera frame."""
    rx, ry, rz = tile[X], tile[Y], tile[Z]
    t00, t01, t02, t03 = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    t10, t11, t12, t13 = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    t20, t21, t22, t23 = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    for i in range(n):
        at = np.uint64(start + i)
        px, py, pz = columns[0, at], columns[1, at], columns[2, at]
        rx[i] = t00 * px + t01 * py + t02 * pz + t03
        ry[i] = t10 * px + t11 * py + t12 * pz + t13
        rz[i] = t20 * px + t21 * py + t22 * pz + t23


@compiled(inline="always")
def project_others(kind, lens, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals and their derivatives of the points for which the formulas below do not hold."""
    for i in range(n):
        if tile[OTHER, i] != 0.0:
            at = np.uint64(start + i)
            u, v, ux, uy, uz, vx, vy, vz = project_one(
                kind, lens, tile[X, i], tile[Y, i], tile[Z, i]
            )
            tile[RU, i], tile[RV, i] = u - columns[3, at], v - columns[4, at]
            tile[UX, i], tile[UY, i], tile[UZ, i] = ux, uy, uz
            tile[VX, i], tile[VY, i], tile[VZ, i] = vx, vy, vz


# The projections below have no branches, hold in the lens' domain, and mark other points.
@compiled(part=True, fastmath=FAST)
def project_pinhole(lens, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals of a pinhole; False, if there are other points."""
    ru, rv, rx, ry, rz, other = tile[RU], tile[RV], tile[X], tile[Y], tile[Z], tile[OTHER]
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit = (
        lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8], lens[9],
        lens[10], lens[11], lens[12],
    )  # fmt: skip
    others = 0.0
    for i in range(n):
        at, z = np.uint64(start + i), rz[i]
        w = 1.0 / z
        a, b = rx[i] * w, ry[i] * w
        r2 = a * a + b * b
        other[i] = 0.0 if z > MIN_DEPTH_M and r2 <= limit * limit else 1.0
        others += other[i]
        radial, twice = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), 2.0 * (p1 * b + p2 * a)
        radial = radial / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))) + twice
        ru[i] = fx * (a * radial + p2 * r2) + (cx - columns[3, at])
        rv[i] = fy * (b * radial + p1 * r2) + (cy - columns[4, at])
    return others == 0.0


@compiled(part=True, fastmath=FAST)
def differentiate_pinhole(lens, n, tile):  # type: ignore[no-untyped-def]
    """The derivatives of a pinhole's pixels by the points."""
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    rx, ry, rz = tile[X], tile[Y], tile[Z]
    fx, fy, k1, k2, p1, p2, k3, k4, k5, k6 = (
        lens[0], lens[1], lens[4], lens[5], lens[6], lens[7], lens[8], lens[9], lens[10], lens[11],
    )  # fmt: skip
    undistorted = math.isinf(lens[LIMIT])
    for i in range(n if undistorted else 0):
        w = 1.0 / rz[i]
        ux[i], uy[i], uz[i] = fx * w, 0.0, -fx * rx[i] * w * w
        vx[i], vy[i], vz[i] = 0.0, fy * w, -fy * ry[i] * w * w
    for i in range(0 if undistorted else n):
        w = 1.0 / rz[i]
        a, b = rx[i] * w, ry[i] * w
        _, _, by_a, cross, _, by_b = distort(a, b, k1, k2, p1, p2, k3, k4, k5, k6)
        fxw, fyw = fx * w, fy * w
        ux[i], uy[i], uz[i] = fxw * by_a, fxw * cross, -fxw * (by_a * a + cross * b)
        vx[i], vy[i], vz[i] = fyw * cross, fyw * by_b, -fyw * (cross * a + by_b * b)


@compiled(part=True, fastmath=FAST)
def project_fisheye(lens, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals of a fisheye and their derivatives; False, if there are other points.

    The field angle is 16 times one of tangent t <= 0.199, whose series of 11 terms is exact: of
    half the angle the tangent is rho / m, m = n + z; of half of that rho / (m + hypot(m, rho)).
    Points on the axis are others.
    """
    ru, rv = tile[RU], tile[RV]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    rx, ry, rz, other = tile[X], tile[Y], tile[Z], tile[OTHER]
    fx, fy, cx, cy, limit = lens[0], lens[1], lens[2], lens[3], lens[LIMIT]
    k1, k2, k3, k4 = lens[4], lens[5], lens[6], lens[7]
    others = 0.0
    for i in range(n):
        at, x, y, z = np.uint64(start + i), rx[i], ry[i], rz[i]
        rho2 = x * x + y * y
        n2 = rho2 + z * z
        m = math.sqrt(n2) + z
        m += math.sqrt(m * m + rho2)
        m += math.sqrt(m * m + rho2)
        m += math.sqrt(m * m + rho2)
        rho = math.sqrt(rho2)
        t, over, over_n2 = rho / m, 1.0 / rho, 1.0 / n2
        s = -t * t
        series = 1 / 13 + s * (1 / 15 + s * (1 / 17 + s * (1 / 19 + s * (1 / 21))))
        series = 1 / 5 + s * (1 / 7 + s * (1 / 9 + s * (1 / 11 + s * series)))
        theta = 16.0 * t * (1.0 + s * (1 / 3 + s * series))
        other[i] = 0.0 if theta < limit and rho2 > ON_AXIS * n2 else 1.0
        others += other[i]
        t2 = theta * theta
        distorted = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))
        scale, slope = distorted * over, slope * over_n2
        along, wz = (slope * z - scale) * over * over, -slope
        ru[i], rv[i] = (
            fx * x * scale + (cx - columns[3, at]),
            fy * y * scale + (cy - columns[4, at]),
        )
        cross = x * y * along
        ux[i], uy[i], uz[i] = fx * (scale + x * x * along), fx * cross, fx * x * wz
        vx[i], vy[i], vz[i] = fy * cross, fy * (scale + y * y * along), fy * y * wz
    return others == 0.0


@compiled(part=True, fastmath=FAST)
def project_omnidirectional(lens, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals by the unified model and their derivatives; False, if there are other points."""
    ru, rv = tile[RU], tile[RV]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    rx, ry, rz, other = tile[X], tile[Y], tile[Z], tile[OTHER]
    fx, fy, cx, cy, xi, least = lens[0], lens[1], lens[2], lens[3], lens[4], math.cos(lens[LIMIT])
    k1, k2, p1, p2 = lens[5], lens[6], lens[7], lens[8]
    others = 0.0
    for i in range(n):
        at, x, y, z = np.uint64(start + i), rx[i], ry[i], rz[i]
        length = math.sqrt(x * x + y * y + z * z)
        w, over = 1.0 / (z + xi * length), xi / length
        other[i] = 0.0 if z > least * length and z + xi * length > MIN_RANGE_M else 1.0
        others += other[i]
        p, q, by_a, by_b, _, qb = distort(x * w, y * w, k1, k2, p1, p2, 0.0, 0.0, 0.0, 0.0)
        ru[i], rv[i] = fx * p + (cx - columns[3, at]), fy * q + (cy - columns[4, at])
        by_w_p, by_w_q = by_a * x + by_b * y, by_b * x + qb * y
        wx, wy, wz = -w * x * over, -w * y * over, -w * (1.0 + z * over)
        fxw, fyw = fx * w, fy * w
        ux[i], uy[i], uz[i] = (
            fxw * (by_a + by_w_p * wx),
            fxw * (by_b + by_w_p * wy),
            fxw * by_w_p * wz,
        )
        vx[i], vy[i], vz[i] = (
            fyw * (by_b + by_w_q * wx),
            fyw * (qb + by_w_q * wy),
            fyw * by_w_q * wz,
        )
    return others == 0.0


@compiled(part=True, fastmath=FAST)
def complete(sigma, sums):  # type: ignore[no-untyped-def]
    """Fill in the lower triangle, and divide by the variance."""
    size = len(sums) - 1
    for i in range(size):
        for j in range(i, size):
            sums[i, j] /= sigma * sigma
            sums[j, i] = sums[i, j]
    sums[size, 0] /= sigma * sigma


@compiled(part=True, fastmath=FAST)
def add_by_pose(n, tile, sums):  # type: ignore[no-untyped-def]
    """Add the sums by the pose, of a tile's residuals r and derivatives G by the points q.

    J = (G [q]x, -G), and g^T [q]x = (g x q)^T. So with S = psi G^T G and C v = v x q, the blocks of
    H are C S C^T, -C S and S, and b = (C g, -g) with g = psi G^T r.
    """
    ru, rv, weight = tile[RU], tile[RV], tile[PSI]
    ux, uy, uz, vx, vy, vz = tile[UX], tile[UY], tile[UZ], tile[VX], tile[VY], tile[VZ]
    rx, ry, rz = tile[X], tile[Y], tile[Z]
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = h22 = h23 = h24 = h25 = 0.0
    h33 = h34 = h35 = h44 = h45 = h55 = b0 = b1 = b2 = b3 = b4 = b5 = squares = weights = 0.0
    for i in range(n):
        psi, u, v, x, y, z = weight[i], ru[i], rv[i], rx[i], ry[i], rz[i]
        weights += psi
        squares += psi * (u * u + v * v)
        a, b, c, d, e, f = ux[i], uy[i], uz[i], vx[i], vy[i], vz[i]
        pa, pb, pc, pd, pe, pf = psi * a, psi * b, psi * c, psi * d, psi * e, psi * f
        xx, xy, xz = pa * a + pd * d, pa * b + pd * e, pa * c + pd * f
        yy, yz, zz = pb * b + pe * e, pb * c + pe * f, pc * c + pf * f
        h33 += xx
        h34 += xy
        h35 += xz
        h44 += yy
        h45 += yz
        h55 += zz
        c00, c01, c02 = z * xy - y * xz, z * yy - y * yz, z * yz - y * zz
        c10, c11, c12 = x * xz - z * xx, x * yz - z * xy, x * zz - z * xz
        c20, c21, c22 = y * xx - x * xy, y * xy - x * yy, y * xz - x * yz
        h03 -= c00
        h04 -= c01
        h05 -= c02
        h13 -= c10
        h14 -= c11
        h15 -= c12
        h23 -= c20
        h24 -= c21
        h25 -= c22
        h00 += z * c01 - y * c02
        h01 += x * c02 - z * c00
        h02 += y * c00 - x * c01
        h11 += x * c12 - z * c10
        h12 += y * c10 - x * c11
        h22 += y * c20 - x * c21
        gx, gy, gz = pa * u + pd * v, pb * u + pe * v, pc * u + pf * v
        b0 += z * gy - y * gz
        b1 += x * gz - z * gx
        b2 += y * gx - x * gy
        b3 -= gx
        b4 -= gy
        b5 -= gz
    each = (
        h00, h01, h02, h03, h04, h05, b0, h11, h12, h13, h14, h15, b1, h22, h23, h24, h25, b2,
        h33, h34, h35, b3, h44, h45, b4, h55, b5, squares,
    )  # fmt: skip
    row = column = 0
    for k in range(28):
        sums[row, column] += each[k]
        row, column = (row, column + 1) if column < 6 else (row + 1, row + 1)  # noqa: PLR2004
    sums[7, 1] += weights
