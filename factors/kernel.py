"""The compiled pass over correspondences: H, b and c of the block factor, and plain residuals.

Points come as columns (structure of arrays); a run of correspondences is cut into tiles, and each
tile goes through a few loops that the compiler vectorizes: ``kernel_projection`` gives residuals
and derivatives, ``kernel_sums`` weighs and adds them up.
"""

import math
import warnings

import numpy as np
from numba import prange
from numba.core.errors import NumbaWarning

from factors.compiled import compiled
from factors.conditioning import compiled_square_root
from factors.kernel_projection import project, project_pinhole, project_radtan, project_rays
from factors.kernel_sums import (
    apply_weights,
    scale_residuals,
    sum_ray_gradients,
    sum_rays,
    sum_tile,
    sum_tile_gradients,
    weigh,
    whiten,
)
from factors.lens_kernels import PINHOLE, RADTAN, is_projectable
from factors.tile import FAST, MATRICES, ROWS, RU, RV, TILE, X, Y, Z

# Open3D brings an older libtbb than numba uses; numba then takes another library, as good.
warnings.filterwarnings("ignore", "The TBB threading layer requires", NumbaWarning)


@compiled()
def _project_with_derivatives(kind, lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Fill in a tile, for any lens and any points."""
    if kind == PINHOLE:
        project_pinhole(lens, T, columns, start, n, tile)
    elif kind != RADTAN or not project_radtan(lens, T, columns, start, n, tile):
        project(kind, lens, T, columns, start, n, tile)


@compiled()
def _accumulate(kind, lens, T, columns, whitening, loss, scale, first, end, sums):  # type: ignore[no-untyped-def]
    """Add a run of correspondences to (28,) sums: 21 of H, 6 of b, 1 of c."""
    tile = np.empty((ROWS, TILE))
    for start in range(first, end, TILE):
        n = min(TILE, end - start)
        rays = kind == PINHOLE and whitening.shape[0] < MATRICES
        if rays and project_rays(lens, T, columns, start, n, tile):
            scale_residuals(whitening, start, n, tile)
            sums[27] += weigh(loss, scale, n, tile)
            apply_weights(whitening, start, n, tile)
            sum_rays(lens, n, tile, sums)
            continue
        _project_with_derivatives(kind, lens, T, columns, start, n, tile)
        whiten(whitening, start, n, tile)
        sums[27] += weigh(loss, scale, n, tile)
        sum_tile(n, tile, sums)


def _accumulate_runs(kind, lens, poses, columns, whitening, loss, scales, runs):  # type: ignore[no-untyped-def]
    """(r, 28) sums over the runs ``runs[i, 0]:runs[i, 1]``: 21 of H, 6 of b, 1 of c.

    ``poses`` (r, 4, 4) are T_camera_lidar and ``scales`` (r,) the loss', each of one run, or
    (1, 4, 4) and (1,) of all; ``columns`` (5, n) are x y z u v; ``whitening`` is (3, n): triangular
    matrices; (1, n): numbers; or (0, n): none.
    """
    out = np.zeros((len(runs), 28))
    for i in prange(len(runs)):
        T, scale = (
            poses[min(np.int64(i), len(poses) - 1)],
            scales[min(np.int64(i), len(scales) - 1)],
        )
        first, end = runs[i, 0], runs[i, 1]
        _accumulate(kind, lens, T, columns, whitening, loss, scale, first, end, out[i])
    return out


accumulate_alone = compiled()(_accumulate_runs)
accumulate_shared = compiled(parallel=True)(_accumulate_runs)


@compiled()
def linearize_alone(kind, lens, T, columns, whitening, loss, scale, sigma, runs):  # type: ignore[no-untyped-def]
    """(7,) error and transposed (6, 7) Jacobian of the block factor, see ``block.square_root``.

    Sums are added run by run, as of ``accumulate_alone``.
    """
    sums = np.zeros(28)
    for i in range(len(runs)):
        own = np.zeros(28)
        first, end = runs[i, 0], runs[i, 1]
        _accumulate(kind, lens, T, columns, whitening, loss, scale, first, end, own)
        sums += own
    sums /= sigma * sigma
    hessian, k = np.empty((6, 6)), 0
    for i in range(6):
        for j in range(i, 6):
            hessian[i, j] = hessian[j, i] = sums[k]
            k += 1
    return compiled_square_root(hessian, sums[21:27], sums[27])


@compiled()
def costs_alone(kind, lens, poses, columns, whitening, loss, scale):  # type: ignore[no-untyped-def]
    """(p,) costs c of all correspondences at each of (p, 4, 4) T_camera_lidar."""
    out, tile = np.zeros(len(poses)), np.empty((ROWS, TILE))
    n = columns.shape[1]
    for start in range(0, n, TILE):
        count = min(TILE, n - start)
        for i in range(len(poses)):
            _project_any(kind, lens, poses[i], columns, start, count, tile)
            whiten(whitening, start, count, tile)
            out[i] += weigh(loss, scale, count, tile)
    return out


@compiled()
def gradients_alone(kind, lens, poses, columns, whitening, loss, scale):  # type: ignore[no-untyped-def]
    """(p, 6) gradients b of all correspondences at each of (p, 4, 4) T_camera_lidar."""
    out, tile = np.zeros((len(poses), 6)), np.empty((ROWS, TILE))
    n = columns.shape[1]
    for start in range(0, n, TILE):
        count = min(TILE, n - start)
        for i in range(len(poses)):
            rays = kind == PINHOLE and whitening.shape[0] < MATRICES
            if rays and project_rays(lens, poses[i], columns, start, count, tile):
                scale_residuals(whitening, start, count, tile)
                weigh(loss, scale, count, tile)
                apply_weights(whitening, start, count, tile)
                sum_ray_gradients(lens, count, tile, out[i])
                continue
            _project_with_derivatives(kind, lens, poses[i], columns, start, count, tile)
            whiten(whitening, start, count, tile)
            weigh(loss, scale, count, tile)
            sum_tile_gradients(count, tile, out[i])
    return out


@compiled()
def _project_any(kind, lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Fill in the residuals of a tile; whether all points lie where the fast ways hold."""
    ahead = (kind == PINHOLE and project_rays(lens, T, columns, start, n, tile)) or (
        kind == RADTAN and project_radtan(lens, T, columns, start, n, tile)
    )
    if not ahead:
        project(kind, lens, T, columns, start, n, tile)
    return ahead


@compiled()
def _evaluate(kind, lens, T, columns, first, end, residuals, valid):  # type: ignore[no-untyped-def]
    """Fill in the residuals of a run of correspondences, and whether each point is projectable."""
    tile = np.empty((ROWS, TILE))
    for start in range(first, end, TILE):
        n = min(TILE, end - start)
        ahead = _project_any(kind, lens, T, columns, start, n, tile)
        for i in range(n):
            residuals[start + i, 0], residuals[start + i, 1] = tile[RU, i], tile[RV, i]
            valid[start + i] = ahead or is_projectable(
                kind, lens, tile[X, i], tile[Y, i], tile[Z, i]
            )


def _residuals(kind, lens, poses, columns, runs):  # type: ignore[no-untyped-def]
    """(n, 2) residuals pi - u [px], and (n,) whether each point is projectable.

    ``poses`` and ``runs`` as above; the runs hold every point once.
    """
    n = columns.shape[1]
    residuals, valid = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
    for i in prange(len(runs)):
        T = poses[min(np.int64(i), len(poses) - 1)]
        _evaluate(kind, lens, T, columns, runs[i, 0], runs[i, 1], residuals, valid)
    return residuals, valid


residuals_alone = compiled()(_residuals)
residuals_shared = compiled(parallel=True)(_residuals)


@compiled(fastmath=FAST)
def _norms_of_tile(whitening, start, n, tile, factor, norms):  # type: ignore[no-untyped-def]
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


@compiled()
def norms_alone(kind, lens, poses, columns, whitening, factor, runs):  # type: ignore[no-untyped-def]
    """(1, n) norms of the residuals [px] times a factor, and, with whitening, (2, n) those of both.

    Infinite where a point is not projectable; ``poses`` and ``runs`` as above.
    """
    norms = np.empty((1 if whitening.shape[0] == 0 else 2, columns.shape[1]))
    tile = np.empty((ROWS, TILE))
    for i in range(len(runs)):
        T = poses[min(i, len(poses) - 1)]
        for start in range(runs[i, 0], runs[i, 1], TILE):
            n = min(TILE, runs[i, 1] - start)
            ahead = _project_any(kind, lens, T, columns, start, n, tile)
            _norms_of_tile(whitening, start, n, tile, factor, norms)
            if not ahead:
                for k in range(n):
                    if not is_projectable(kind, lens, tile[X, k], tile[Y, k], tile[Z, k]):
                        norms[:, start + k] = math.inf
    return norms
