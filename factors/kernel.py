"""The compiled passes over correspondences: the sums of the block factor, and plain residuals.

Points come as columns (structure of arrays); a run of correspondences is cut into tiles, and each
tile goes through a few loops that the compiler vectorizes: ``kernel_projection`` gives residuals
and derivatives, ``kernel_sums`` weighs and adds them up. There is a kernel per kind of lens, whose
number is a constant in it: the branches of other lenses are not compiled. RAYS is a kind of the
sums', too: it takes half of the time, and a second to compile.
"""

import math
import warnings
from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numba.core.errors import NumbaWarning

from factors.compiled import compiled, one_at_a_time
from factors.kernel_projection import (
    ACROSS,
    FAST,
    MATRICES,
    PSI,
    RAYS,
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
    turn_to_residuals,
    weigh,
    whiten,
)
from factors.lens_kernels import PINHOLE, is_projectable

# Open3D brings an older libtbb than numba uses; numba then takes another library, as good.
warnings.filterwarnings("ignore", "The TBB threading layer requires", NumbaWarning)

COST, HESSIAN, CURVATURE = range(3)
"""Which sums are wanted: c; H, b and c; or the second derivative of c / 2 besides."""

SUMS = {COST: 28, HESSIAN: 28, CURVATURE: 49}
"""How many that is: 21 of H, 6 of b, 1 of c, 21 of the second derivative."""


@cache
def accumulate(kind: int, *, shared: bool = False) -> Any:
    """The kernel of sums over runs of correspondences; ``shared``: by all cores."""

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
                    sum_tile(n, tile, tile[PSI], sums)
                    sum_tile_gradients(n, tile, sums)
                    if wanted == CURVATURE:
                        turn_to_residuals(loss, scale, n, tile)
                        sum_tile(n, tile, tile[ACROSS], sums[28:])

    return one_at_a_time(accumulate_runs) if shared else accumulate_runs


@cache
def evaluate(kind: int, *, norms: bool = False, shared: bool = False) -> Any:
    """The kernel of the residuals, or their norms, of runs; ``shared``: by all cores."""

    @compiled(fastmath=FAST, parallel=shared)
    def evaluate_runs(lens, poses, columns, whitening, factor, runs, out, valid):  # type: ignore[no-untyped-def]
        """Fill residuals or norms, and (n,) whether each point is projectable.

        ``lens`` to ``whitening`` and ``runs`` as of the sums; the runs hold every point once.
        ``out`` (n, 2) are the residuals pi - u [px], or (1 or 2, n) their norms, plain and
        whitened, times a factor, infinite where a point is not projectable.
        """
        for i in prange(len(runs)):
            T, tile = poses[np.int64(i) if len(poses) > 1 else 0], np.empty((ROWS, TILE))
            for start in range(runs[i, 0], runs[i, 1], TILE):
                n = runs[i, 1] - start if runs[i, 1] - start < TILE else TILE
                if kind == PINHOLE:
                    inside = project_pinhole(lens, T, columns, start, n, tile)
                else:
                    project(kind, lens, T, columns, start, n, tile)
                    inside = False
                for k in range(n):
                    valid[start + k] = inside or is_projectable(
                        kind, lens, tile[X, k], tile[Y, k], tile[Z, k]
                    )
                if norms:
                    fill_norms(whitening, start, n, tile, factor, out)
                    for k in range(0 if inside else n):
                        if not valid[start + k]:
                            for row in range(len(out)):  # a slice compiles for half a second
                                out[row, start + k] = math.inf
                else:
                    for k in range(n):
                        out[start + k, 0], out[start + k, 1] = tile[RU, k], tile[RV, k]

    return one_at_a_time(evaluate_runs) if shared else evaluate_runs


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
