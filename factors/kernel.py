"""The compiled pass over correspondences: H, b and c of the block factor, and plain residuals.

Points come as columns (structure of arrays); a run of correspondences is cut into tiles that stay
in the first-level cache, and each tile goes through four loops that the compiler vectorizes.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from factors.lens import MIN_DEPTH_M, PINHOLE, is_projectable, project_one
from factors.loss import CAUCHY, loss_and_weight

_FAST = {"reassoc", "contract", "nsz", "arcp"}
_SMALL = 1e-200  # far from the smallest float by more than one factor
_TILE = 128  # correspondences whose 12 intermediate values stay in the first-level cache
(_RU, _RV, _UX, _UY, _UZ, _VX, _VY, _VZ, _X, _Y, _Z, _PSI) = range(12)  # rows of a tile


def _accumulate(kind, lens, T, columns, whitening, loss, scale, edges):  # type: ignore[no-untyped-def]
    """(segments, 28) sums over the runs ``edges[i]:edges[i + 1]``: 21 of H, 6 of b, 1 of c.

    ``T`` is T_camera_lidar; ``columns`` (5, n) are x y z u v, ``whitening`` (3, n) or (3, 0).
    """
    out = np.zeros((len(edges) - 1, 28))
    for segment in prange(len(edges) - 1):
        tile = np.empty((12, _TILE))
        for start in range(edges[segment], edges[segment + 1], _TILE):
            n = min(_TILE, edges[segment + 1] - start)
            if kind == PINHOLE:
                _project_pinhole(lens, T, columns, start, n, tile)
            else:
                _project(kind, lens, T, columns, start, n, tile)
            if whitening.shape[1] > 0:
                _whiten(whitening, start, n, tile)
            out[segment, 27] += _weigh(loss, scale, n, tile)
            _sum_tile(n, tile, out, segment)
    return out


accumulate_alone = njit(cache=True)(_accumulate)
accumulate_shared = njit(cache=True, parallel=True)(_accumulate)


@njit(cache=True, fastmath=_FAST)
def _project_pinhole(lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """``_project`` for a pinhole without distortion: no branch, so that it vectorizes."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for i in range(n):
        px, py, pz = columns[0, start + i], columns[1, start + i], columns[2, start + i]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        w = 1.0 / max(z, MIN_DEPTH_M)
        wz = w if z > MIN_DEPTH_M else 0.0
        u, v = fx * x * w, fy * y * w
        tile[_RU, i] = u + cx - columns[3, start + i]
        tile[_RV, i] = v + cy - columns[4, start + i]
        tile[_UX, i], tile[_UY, i], tile[_UZ, i] = fx * w, 0.0, -u * wz
        tile[_VX, i], tile[_VY, i], tile[_VZ, i] = 0.0, fy * w, -v * wz
        tile[_X, i], tile[_Y, i], tile[_Z, i] = x, y, z


@njit(cache=True, fastmath=_FAST)
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


@njit(cache=True, fastmath=_FAST)
def _whiten(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals and derivatives by the upper triangular whitening matrices."""
    for i in range(n):
        s00, s01, s11 = whitening[0, start + i], whitening[1, start + i], whitening[2, start + i]
        tile[_RU, i] = s00 * tile[_RU, i] + s01 * tile[_RV, i]
        tile[_UX, i] = s00 * tile[_UX, i] + s01 * tile[_VX, i]
        tile[_UY, i] = s00 * tile[_UY, i] + s01 * tile[_VY, i]
        tile[_UZ, i] = s00 * tile[_UZ, i] + s01 * tile[_VZ, i]
        tile[_RV, i] *= s11
        tile[_VX, i] *= s11
        tile[_VY, i] *= s11
        tile[_VZ, i] *= s11


@njit(cache=True, fastmath=_FAST)
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
    for i in range(n):
        ratio = 1.0 + k * (tile[_RU, i] * tile[_RU, i] + tile[_RV, i] * tile[_RV, i])
        tile[_PSI, i] = 1.0 / ratio
    # The sum of logarithms is the logarithm of the product, taken before it leaves the range of
    # a float: a division and a multiplication each instead of a logarithm.
    logarithms, product = 0.0, 1.0
    for i in range(n):
        product *= tile[_PSI, i]
        if product < _SMALL:
            logarithms += math.log(product)
            product = 1.0
    return -(logarithms + math.log(product)) / k


@njit(cache=True, fastmath=_FAST)
def _sum_tile(n, tile, out, segment):  # type: ignore[no-untyped-def]
    """Add J^T psi J and J^T psi r of a tile to the 27 sums of a segment."""
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = 0.0
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = 0.0
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        # q = X^-1 p:  dq / d(rotation, translation) = ([q]x, -I);  g^T [q]x = (g x q)^T.
        x, y, z, psi = tile[_X, i], tile[_Y, i], tile[_Z, i], tile[_PSI, i]
        u3, u4, u5 = -tile[_UX, i], -tile[_UY, i], -tile[_UZ, i]
        v3, v4, v5 = -tile[_VX, i], -tile[_VY, i], -tile[_VZ, i]
        u0, u1, u2 = u5 * y - u4 * z, u3 * z - u5 * x, u4 * x - u3 * y
        v0, v1, v2 = v5 * y - v4 * z, v3 * z - v5 * x, v4 * x - v3 * y
        a0, a1, a2, a3, a4, a5 = psi * u0, psi * u1, psi * u2, psi * u3, psi * u4, psi * u5
        c0, c1, c2, c3, c4, c5 = psi * v0, psi * v1, psi * v2, psi * v3, psi * v4, psi * v5
        ru, rv = tile[_RU, i], tile[_RV, i]
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


@njit(cache=True)
def residuals_of(kind, lens, T, columns):  # type: ignore[no-untyped-def]
    """(n, 2) residuals pi - u [px], and (n,) whether each point is projectable."""
    n = columns.shape[1]
    residuals = np.empty((n, 2))
    valid = np.empty(n, dtype=np.bool_)
    for k in range(n):
        px, py, pz = columns[0, k], columns[1, k], columns[2, k]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        projection = project_one(kind, lens, x, y, z)
        residuals[k, 0] = projection[0] - columns[3, k]
        residuals[k, 1] = projection[1] - columns[4, k]
        valid[k] = is_projectable(kind, lens, x, y, z)
    return residuals, valid
