"""The compiled pass over correspondences: H, b and c of the block factor, and plain residuals.

Points come as columns (structure of arrays); a run of correspondences is cut into tiles, and each
tile goes through a few loops that the compiler vectorizes: ``kernel_projection`` gives residuals
and derivatives, ``kernel_sums`` weighs and adds them up.
"""

from __future__ import annotations

import warnings

import numpy as np
from numba import prange
from numba.core.errors import NumbaWarning

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
from factors.lens import PINHOLE, RADTAN, is_projectable
from factors.tile import MATRICES, ROWS, RU, RV, TILE, X, Y, Z

# Open3D brings an older libtbb than numba uses; numba then takes another library, as good.
warnings.filterwarnings("ignore", "The TBB threading layer requires", NumbaWarning)


def _accumulate(kind, lens, poses, columns, whitening, loss, scale, edges):  # type: ignore[no-untyped-def]
    """(p, s, 28) sums at each pose over each run ``edges[i]:edges[i + 1]``: H (21), b (6), c (1).

    ``poses`` (p, 4, 4) are T_camera_lidar; ``columns`` (5, n) are x y z u v; ``whitening`` is
    (3, n): triangular matrices; (1, n): numbers; or (0, n): none.
    """
    segments = len(edges) - 1
    out = np.zeros((len(poses) * segments, 28))
    for row in prange(len(poses) * segments):
        T, segment = poses[row // segments], row % segments
        tile = np.empty((ROWS, TILE))
        for start in range(edges[segment], edges[segment + 1], TILE):
            n = min(TILE, edges[segment + 1] - start)
            rays = kind == PINHOLE and whitening.shape[0] < MATRICES
            if rays and project_rays(lens, T, columns, start, n, tile):
                scale_residuals(whitening, start, n, tile)
                out[row, 27] += weigh(loss, scale, n, tile)
                apply_weights(whitening, start, n, tile)
                sum_rays(lens, n, tile, out, row)
                continue
            if kind == PINHOLE:
                project_pinhole(lens, T, columns, start, n, tile)
            elif kind != RADTAN or not project_radtan(lens, T, columns, start, n, tile):
                project(kind, lens, T, columns, start, n, tile)
            whiten(whitening, start, n, tile)
            out[row, 27] += weigh(loss, scale, n, tile)
            sum_tile(n, tile, out, row)
    return out.reshape((len(poses), segments, 28))


accumulate_alone = compiled(nogil=True, error_model="numpy")(_accumulate)
accumulate_shared = compiled(parallel=True, error_model="numpy")(_accumulate)


def _residuals(kind, lens, T, columns):  # type: ignore[no-untyped-def]
    """(n, 2) residuals pi - u [px], and (n,) whether each point is projectable."""
    n = columns.shape[1]
    residuals = np.empty((n, 2))
    valid = np.empty(n, dtype=np.bool_)
    for number in prange((n + TILE - 1) // TILE):
        tile = np.empty((ROWS, TILE))
        start = number * TILE
        count = min(TILE, n - start)
        ahead = (kind == PINHOLE and project_rays(lens, T, columns, start, count, tile)) or (
            kind == RADTAN and project_radtan(lens, T, columns, start, count, tile)
        )
        if not ahead:
            project(kind, lens, T, columns, start, count, tile)
        for i in range(count):
            residuals[start + i, 0], residuals[start + i, 1] = tile[RU, i], tile[RV, i]
            valid[start + i] = ahead or is_projectable(
                kind, lens, tile[X, i], tile[Y, i], tile[Z, i]
            )
    return residuals, valid


residuals_alone = compiled(nogil=True, error_model="numpy")(_residuals)
residuals_shared = compiled(parallel=True, error_model="numpy")(_residuals)
