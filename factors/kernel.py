"""The compiled pass over correspondences: H, b and c of the block factor, and plain residuals.

Points come as columns (structure of arrays); a run of correspondences is cut into tiles, and each
tile goes through a few loops that the compiler vectorizes: ``kernel_projection`` gives residuals
and derivatives, ``kernel_sums`` weighs and adds them up.
"""

from __future__ import annotations

import warnings

import numpy as np
from numba import prange

from factors.compiled import compiled
from factors.kernel_projection import project, project_pinhole, project_radtan, project_rays
from factors.kernel_sums import (
    apply_weights,
    scale_residuals,
    sum_rays,
    sum_tile,
    weigh,
    whiten,
)
from factors.lens_kernels import PINHOLE, RADTAN, is_projectable
from factors.tile import MATRICES, ROWS, RU, RV, TILE, X, Y, Z

# Open3D brings an older libtbb than numba uses; numba then takes another library, as good.
warnings.filterwarnings("ignore", ".*The TBB threading layer requires")


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
