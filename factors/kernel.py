"""The compiled passes over correspondences: the sums of the block factor, and plain residuals.

Points come as columns (structure of arrays); a run of correspondences is cut into tiles, and each
tile goes through a few loops that the compiler vectorizes: ``kernel_projection`` gives residuals
and derivatives, ``kernel_sums`` weighs and adds them up. There is a kernel per kind of lens, whose
number is a constant in it: the branches of other lenses are not compiled.
"""

import math
import warnings
from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numba.core.errors import NumbaWarning

from factors.compiled import compiled
from factors.kernel_projection import (
    FAST,
    MATRICES,
    ROWS,
    RU,
    RV,
    TILE,
    X,
    Y,
    Z,
    project,
    project_pinhole,
    project_rays,
)
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
from factors.lens_kernels import LIMIT, PINHOLE, is_projectable

# Open3D brings an older libtbb than numba uses; numba then takes another library, as good.
warnings.filterwarnings("ignore", "The TBB threading layer requires", NumbaWarning)

COST, GRADIENT, HESSIAN = range(3)
"""Which sums are wanted: c; c and b; or all."""


@cache
def accumulate(kind: int, *, shared: bool = False) -> Any:
    """The kernel of sums over runs of correspondences; ``shared``: by all cores."""

    @compiled(fastmath=FAST, parallel=shared)
    def accumulate_runs(lens, poses, columns, whitening, loss, scales, runs, wanted):  # type: ignore[no-untyped-def]
        """(r, 28) sums over the runs ``runs[i, 0]:runs[i, 1]``: 21 of H, 6 of b, 1 of c.

        ``poses`` (r, 4, 4) are T_camera_lidar and ``scales`` (r,) the loss', each of one run, or
        (1, 4, 4) and (1,) of all; ``columns`` (5, n) are x y z u v; ``whitening`` is (3, n):
        triangular matrices; (1, n): numbers; or (0, n): none.
        """
        out = np.empty((len(runs), 28))
        for i in prange(len(runs)):
            T = poses[np.int64(i) if len(poses) > 1 else 0]
            scale = scales[np.int64(i) if len(scales) > 1 else 0]
            sums, tile = out[i], np.empty((ROWS, TILE))
            for k in range(28):
                sums[k] = 0.0
            for start in range(runs[i, 0], runs[i, 1], TILE):
                n = min(TILE, runs[i, 1] - start)
                rays = False
                if kind == PINHOLE:
                    if lens[LIMIT] == math.inf and whitening.shape[0] < MATRICES:
                        rays = project_rays(lens, T, columns, start, n, tile)
                    if not rays:
                        project_pinhole(lens, T, columns, start, n, tile)
                else:
                    project(kind, lens, T, columns, start, n, tile)
                if rays:
                    scale_residuals(whitening, start, n, tile)
                else:
                    whiten(whitening, start, n, tile)
                sums[27] += weigh(loss, scale, n, tile)
                if wanted == COST:
                    continue
                if kind == PINHOLE and rays:
                    apply_weights(whitening, start, n, tile)
                    if wanted == HESSIAN:
                        sum_rays(lens, n, tile, sums)
                    sum_ray_gradients(lens, n, tile, sums)
                else:
                    if wanted == HESSIAN:
                        sum_tile(n, tile, sums)
                    sum_tile_gradients(n, tile, sums)
        return out

    return accumulate_runs


@cache
def evaluate(kind: int, *, shared: bool = False) -> Any:
    """The kernel of the residuals of runs of correspondences; ``shared``: by all cores."""

    @compiled(fastmath=FAST, parallel=shared)
    def evaluate_runs(lens, poses, columns, whitening, factor, runs, residuals, norms):  # type: ignore[no-untyped-def]
        """Fill residuals or norms, whichever has rows; (n,) whether each point is projectable.

        ``lens`` to ``whitening`` and ``runs`` as of the sums; the runs hold every point once.
        ``residuals`` (n, 2) are pi - u [px]; ``norms`` (1 or 2, n) their norms, plain and whitened,
        times a factor, infinite where a point is not projectable.
        """
        valid = np.empty(columns.shape[1], np.bool_)
        for i in prange(len(runs)):
            T, tile = poses[np.int64(i) if len(poses) > 1 else 0], np.empty((ROWS, TILE))
            for start in range(runs[i, 0], runs[i, 1], TILE):
                n = min(TILE, runs[i, 1] - start)
                fast = False
                if kind == PINHOLE:
                    if lens[LIMIT] == math.inf:
                        fast = project_rays(lens, T, columns, start, n, tile)
                    if not fast:
                        fast = project_pinhole(lens, T, columns, start, n, tile)
                else:
                    project(kind, lens, T, columns, start, n, tile)
                for k in range(n):
                    valid[start + k] = fast or is_projectable(
                        kind, lens, tile[X, k], tile[Y, k], tile[Z, k]
                    )
                for k in range(n if len(residuals) else 0):
                    residuals[start + k, 0], residuals[start + k, 1] = tile[RU, k], tile[RV, k]
                if len(norms):
                    fill_norms(whitening, start, n, tile, factor, norms)
                for k in range(0 if fast else n):
                    if not valid[start + k]:
                        for row in range(len(norms)):  # a slice compiles for half a second
                            norms[row, start + k] = math.inf
        return valid

    return evaluate_runs


@compiled(part=True, fastmath=FAST)
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
