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


def _accumulate_runs(kind, lens, poses, columns, whitening, loss, scales, runs):  # type: ignore[no-untyped-def]
    """(r, 28) sums over the runs ``runs[i, 0]:runs[i, 1]``: 21 of H, 6 of b, 1 of c.

    ``poses`` (r, 4, 4) are T_camera_lidar and ``scales`` (r,) the loss', each of one run, or
    (1, 4, 4) and (1,) of all; ``columns`` (5, n) are x y z u v; ``whitening`` is (3, n): triangular
    matrices; (1, n): numbers; or (0, n): none.
    """
    out = np.zeros((len(runs), 28))
    for i in prange(len(runs)):
        T, scale = poses[i % len(poses)], scales[i % len(scales)]
        tile = np.empty((ROWS, TILE))
        for start in range(runs[i, 0], runs[i, 1], TILE):
            n = min(TILE, runs[i, 1] - start)
            rays = kind == PINHOLE and whitening.shape[0] < MATRICES
            if rays and project_rays(lens, T, columns, start, n, tile):
                scale_residuals(whitening, start, n, tile)
                out[i, 27] += weigh(loss, scale, n, tile)
                apply_weights(whitening, start, n, tile)
                sum_rays(lens, n, tile, out[i])
                continue
            ahead = (kind == PINHOLE and project_pinhole(lens, T, columns, start, n, tile)) or (
                kind == RADTAN and project_radtan(lens, T, columns, start, n, tile)
            )
            if not ahead:
                project(kind, lens, T, columns, start, n, tile)
            whiten(whitening, start, n, tile)
            out[i, 27] += weigh(loss, scale, n, tile)
            sum_tile(n, tile, out[i])
    return out


accumulate_alone = compiled()(_accumulate_runs)
accumulate_shared = compiled(parallel=True)(_accumulate_runs)


def _residuals(kind, lens, poses, columns, runs):  # type: ignore[no-untyped-def]
    """(n, 2) residuals pi - u [px], and (n,) whether each point is projectable.

    ``poses`` and ``runs`` as above; the runs hold every point once.
    """
    n = columns.shape[1]
    residuals, valid = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
    for i in prange(len(runs)):
        T, tile = poses[i % len(poses)], np.empty((ROWS, TILE))
        for start in range(runs[i, 0], runs[i, 1], TILE):
            count = min(TILE, runs[i, 1] - start)
            ahead = (kind == PINHOLE and project_rays(lens, T, columns, start, count, tile)) or (
                kind == RADTAN and project_radtan(lens, T, columns, start, count, tile)
            )
            if not ahead:
                project(kind, lens, T, columns, start, count, tile)
            for k in range(count):
                residuals[start + k, 0], residuals[start + k, 1] = tile[RU, k], tile[RV, k]
                valid[start + k] = ahead or is_projectable(
                    kind, lens, tile[X, k], tile[Y, k], tile[Z, k]
                )
    return residuals, valid


residuals_alone = compiled()(_residuals)
residuals_shared = compiled(parallel=True)(_residuals)
