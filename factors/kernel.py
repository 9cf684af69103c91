"""The compiled pass over correspondences: H, b and c of the block factor, and plain residuals.

Points come as columns (structure of arrays); a run of correspondences is cut into tiles that stay
in the first-level cache, and each tile goes through a few loops that the compiler vectorizes. Two
things would keep it from that: an index that may be negative, hence the rows that are taken out
before a loop, and Python's exception on a division by zero, hence ``error_model="numpy"``.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
from numba import njit, prange
from numba.core.errors import NumbaWarning

from factors.lens import MIN_DEPTH_M, PINHOLE, RADTAN, is_projectable, project_one
from factors.loss import CAUCHY, loss_and_weight

# Open3D brings an older libtbb than numba uses; numba then takes another library, as good.
warnings.filterwarnings("ignore", "The TBB threading layer requires", NumbaWarning)

_FAST = {"reassoc", "contract", "nsz", "arcp"}
_SMALL = 1e-100  # far from the smallest float by more than four factors
_TILE = 256  # correspondences whose intermediate values stay in the first-level cache
(_RU, _RV, _UX, _UY, _UZ, _VX, _VY, _VZ, _X, _Y, _Z, _PSI, _PRODUCT) = range(13)  # rows of a tile
_ROWS = 13
(_A, _B, _W) = (_X, _Y, _Z)  # of a pinhole: x/z, y/z and 1/z
_MATRICES = 3  # rows of the whitening if it is matrices


def _accumulate(kind, lens, T, columns, whitening, loss, scale, edges):  # type: ignore[no-untyped-def]
    """(segments, 28) sums over the runs ``edges[i]:edges[i + 1]``: 21 of H, 6 of b, 1 of c.

    ``T`` is T_camera_lidar; ``columns`` (5, n) are x y z u v; ``whitening`` is (3, n): triangular
    matrices; (1, n): numbers; or (0, n): none.
    """
    out = np.zeros((len(edges) - 1, 28))
    for segment in prange(len(edges) - 1):
        tile = np.empty((_ROWS, _TILE))
        for start in range(edges[segment], edges[segment + 1], _TILE):
            n = min(_TILE, edges[segment + 1] - start)
            rays = kind == PINHOLE and whitening.shape[0] < _MATRICES
            if rays and _project_rays(lens, T, columns, start, n, tile):
                _scale(whitening, start, n, tile)
                out[segment, 27] += _weigh(loss, scale, n, tile)
                _pull(whitening, start, n, tile)
                _sum_rays(lens, n, tile, out, segment)
                continue
            if kind == PINHOLE:
                _project_pinhole(lens, T, columns, start, n, tile)
            elif kind != RADTAN or not _project_radtan(lens, T, columns, start, n, tile):
                _project(kind, lens, T, columns, start, n, tile)
            _whiten(whitening, start, n, tile)
            out[segment, 27] += _weigh(loss, scale, n, tile)
            _sum_tile(n, tile, out, segment)
    return out


accumulate_alone = njit(cache=True, nogil=True, error_model="numpy")(_accumulate)
accumulate_shared = njit(cache=True, parallel=True, error_model="numpy")(_accumulate)


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _project_rays(lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals of a pinhole, x/z, y/z and 1/z. False, if a point is too near for these to hold."""
    xs, ys, zs = columns[0][start:], columns[1][start:], columns[2][start:]
    us, vs = columns[3][start:], columns[4][start:]
    ru, rv, ra, rb, rw = tile[_RU], tile[_RV], tile[_A], tile[_B], tile[_W]
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


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _scale(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals by their weights w, if these are numbers."""
    if whitening.shape[0] == 0:
        return
    ru, rv, weights = tile[_RU], tile[_RV], whitening[0][start:]
    for i in range(n):
        ru[i] *= weights[i]
        rv[i] *= weights[i]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _pull(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Turn the residuals w r into psi w^2 r, and psi into psi w^2, if the weights are numbers."""
    ru, rv, psi = tile[_RU], tile[_RV], tile[_PSI]
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


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _sum_rays(lens, n, tile, out, segment):  # type: ignore[no-untyped-def]
    """Add the 27 sums of a tile of a pinhole, from a = x/z, b = y/z, w = 1/z, psi and psi r.

    The rows of the Jacobian are fx (ab, -A, b, -w, 0, aw) and fy (B, -ab, -a, 0, -w, bw) with
    A = 1 + a^2 and B = 1 + b^2: their 21 products share most of their terms, and the focal lengths
    come in at the end. ``u05``: of the first row's entries 0 and 5, without sign and focal length.
    """
    pull_u, pull_v = tile[_RU], tile[_RV]
    ray_a, ray_b, ray_w, weight = tile[_A], tile[_B], tile[_W], tile[_PSI]
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
    p, q = fx * fx, fy * fy
    sums = (
        p * u00 + q * v00, -p * u01 - q * v01, p * u02 - q * v02, -p * u03, -q * v04,
        p * u05 + q * v05, p * u11 + q * u00, -p * u12 + q * v12, p * u13, q * u03,
        -p * u15 - q * v15, p * u22 + q * v22, -p * u23, q * v24, (p - q) * u03,
        p * u33, 0.0, -p * u35, q * u33, -q * v45, p * u55 + q * v55, b0, b1, b2, b3, b4, b5,
    )  # fmt: skip
    for k in range(27):
        out[segment, k] += sums[k]


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _project_pinhole(lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """``_project`` for a pinhole without distortion: no branch, so that it vectorizes."""
    xs, ys, zs = columns[0][start:], columns[1][start:], columns[2][start:]
    us, vs = columns[3][start:], columns[4][start:]
    ru, rv = tile[_RU], tile[_RV]
    ux, uy, uz, vx, vy, vz = tile[_UX], tile[_UY], tile[_UZ], tile[_VX], tile[_VY], tile[_VZ]
    rx, ry, rz = tile[_X], tile[_Y], tile[_Z]
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for i in range(n):
        px, py, pz = xs[i], ys[i], zs[i]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        w = 1.0 / max(z, MIN_DEPTH_M)
        wz = w if z > MIN_DEPTH_M else 0.0
        u, v = fx * x * w, fy * y * w
        ru[i], rv[i] = u + (cx - us[i]), v + (cy - vs[i])
        ux[i], uy[i], uz[i] = fx * w, 0.0, -u * wz
        vx[i], vy[i], vz[i] = 0.0, fy * w, -v * wz
        rx[i], ry[i], rz[i] = x, y, z


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _project_radtan(lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """``_project`` for radial-tangential distortion, without branches, as ``lens._radtan_inside``.

    False, if a point lies outside the domain in which that holds.
    """
    xs, ys, zs = columns[0][start:], columns[1][start:], columns[2][start:]
    us, vs = columns[3][start:], columns[4][start:]
    ru, rv = tile[_RU], tile[_RV]
    ux, uy, uz, vx, vy, vz = tile[_UX], tile[_UY], tile[_UZ], tile[_VX], tile[_VY], tile[_VZ]
    rx, ry, rz = tile[_X], tile[_Y], tile[_Z]
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, limit = (
        lens[0], lens[1], lens[2], lens[3], lens[4], lens[5], lens[6], lens[7], lens[8], lens[9],
        lens[10], lens[11], lens[12],
    )  # fmt: skip
    outside = 0.0
    for i in range(n):
        px, py, pz = xs[i], ys[i], zs[i]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
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
    return outside == 0.0


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _project(kind, lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals, their derivatives by the point, and the point in the camera frame."""
    for i in range(n):
        px, py, pz = columns[0, start + i], columns[1, start + i], columns[2, start + i]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        u, v, ux, uy, uz, vx, vy, vz = project_one(kind, lens, x, y, z)
        tile[_RU, i] = u - columns[3, start + i]
        tile[_RV, i] = v - columns[4, start + i]
        tile[_UX, i], tile[_UY, i], tile[_UZ, i] = ux, uy, uz
        tile[_VX, i], tile[_VY, i], tile[_VZ, i] = vx, vy, vz
        tile[_X, i], tile[_Y, i], tile[_Z, i] = x, y, z


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _whiten(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals and derivatives by the whitening matrices, or by numbers."""
    if whitening.shape[0] == 0:
        return
    diagonal = whitening.shape[0] == 1
    for i in range(n):
        s00 = whitening[0, start + i]
        s01 = 0.0 if diagonal else whitening[1, start + i]
        s11 = s00 if diagonal else whitening[2, start + i]
        tile[_RU, i] = s00 * tile[_RU, i] + s01 * tile[_RV, i]
        tile[_UX, i] = s00 * tile[_UX, i] + s01 * tile[_VX, i]
        tile[_UY, i] = s00 * tile[_UY, i] + s01 * tile[_VY, i]
        tile[_UZ, i] = s00 * tile[_UZ, i] + s01 * tile[_VZ, i]
        tile[_RV, i] *= s11
        tile[_VX, i] *= s11
        tile[_VY, i] *= s11
        tile[_VZ, i] *= s11


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _weigh(loss, scale, n, tile):  # type: ignore[no-untyped-def]
    """Fill in the weights psi; return the sum of rho."""
    if loss != CAUCHY:
        cost = 0.0
        for i in range(n):
            rho, tile[_PSI, i] = loss_and_weight(
                loss, scale, tile[_RU, i] * tile[_RU, i] + tile[_RV, i] * tile[_RV, i]
            )
            cost += rho
        return cost
    k = 1.0 / (scale * scale)
    ru, rv, psi = tile[_RU], tile[_RV], tile[_PSI]
    for i in range(n):
        psi[i] = 1.0 / (1.0 + k * (ru[i] * ru[i] + rv[i] * rv[i]))
    return -_sum_of_logarithms(psi, n, tile[_PRODUCT]) / k


@njit(cache=True, fastmath=_FAST, error_model="numpy")
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


@njit(cache=True, fastmath=_FAST, error_model="numpy")
def _sum_tile(n, tile, out, segment):  # type: ignore[no-untyped-def]
    """Add J^T psi J and J^T psi r of a tile to the 27 sums of a segment."""
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = 0.0
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = 0.0
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    rx, ry, rz, rp = tile[_X], tile[_Y], tile[_Z], tile[_PSI]
    ux, uy, uz, vx, vy, vz = tile[_UX], tile[_UY], tile[_UZ], tile[_VX], tile[_VY], tile[_VZ]
    res_u, res_v = tile[_RU], tile[_RV]
    for i in range(n):
        # q = X^-1 p:  dq / d(rotation, translation) = ([q]x, -I);  g^T [q]x = (g x q)^T.
        x, y, z, psi = rx[i], ry[i], rz[i], rp[i]
        u3, u4, u5 = -ux[i], -uy[i], -uz[i]
        v3, v4, v5 = -vx[i], -vy[i], -vz[i]
        u0, u1, u2 = u5 * y - u4 * z, u3 * z - u5 * x, u4 * x - u3 * y
        v0, v1, v2 = v5 * y - v4 * z, v3 * z - v5 * x, v4 * x - v3 * y
        a0, a1, a2, a3, a4, a5 = psi * u0, psi * u1, psi * u2, psi * u3, psi * u4, psi * u5
        c0, c1, c2, c3, c4, c5 = psi * v0, psi * v1, psi * v2, psi * v3, psi * v4, psi * v5
        ru, rv = res_u[i], res_v[i]
        h00 += a0 * u0 + c0 * v0
        h01 += a0 * u1 + c0 * v1
        h02 += a0 * u2 + c0 * v2
        h03 += a0 * u3 + c0 * v3
        h04 += a0 * u4 + c0 * v4
        h05 += a0 * u5 + c0 * v5
        h11 += a1 * u1 + c1 * v1
        h12 += a1 * u2 + c1 * v2
        h13 += a1 * u3 + c1 * v3
        h14 += a1 * u4 + c1 * v4
        h15 += a1 * u5 + c1 * v5
        h22 += a2 * u2 + c2 * v2
        h23 += a2 * u3 + c2 * v3
        h24 += a2 * u4 + c2 * v4
        h25 += a2 * u5 + c2 * v5
        h33 += a3 * u3 + c3 * v3
        h34 += a3 * u4 + c3 * v4
        h35 += a3 * u5 + c3 * v5
        h44 += a4 * u4 + c4 * v4
        h45 += a4 * u5 + c4 * v5
        h55 += a5 * u5 + c5 * v5
        b0 += a0 * ru + c0 * rv
        b1 += a1 * ru + c1 * rv
        b2 += a2 * ru + c2 * rv
        b3 += a3 * ru + c3 * rv
        b4 += a4 * ru + c4 * rv
        b5 += a5 * ru + c5 * rv
    sums = (
        h00, h01, h02, h03, h04, h05, h11, h12, h13, h14, h15, h22, h23, h24, h25, h33, h34, h35,
        h44, h45, h55, b0, b1, b2, b3, b4, b5,
    )  # fmt: skip
    for k in range(27):
        out[segment, k] += sums[k]


def _residuals(kind, lens, T, columns):  # type: ignore[no-untyped-def]
    """(n, 2) residuals pi - u [px], and (n,) whether each point is projectable."""
    n = columns.shape[1]
    residuals = np.empty((n, 2))
    valid = np.empty(n, dtype=np.bool_)
    for number in prange((n + _TILE - 1) // _TILE):
        tile = np.empty((_ROWS, _TILE))
        start = number * _TILE
        count = min(_TILE, n - start)
        ahead = (kind == PINHOLE and _project_rays(lens, T, columns, start, count, tile)) or (
            kind == RADTAN and _project_radtan(lens, T, columns, start, count, tile)
        )
        if not ahead:
            _project(kind, lens, T, columns, start, count, tile)
        for i in range(count):
            residuals[start + i, 0], residuals[start + i, 1] = tile[_RU, i], tile[_RV, i]
            valid[start + i] = ahead or is_projectable(
                kind, lens, tile[_X, i], tile[_Y, i], tile[_Z, i]
            )
    return residuals, valid


residuals_alone = njit(cache=True, nogil=True, error_model="numpy")(_residuals)
residuals_shared = njit(cache=True, parallel=True, error_model="numpy")(_residuals)
