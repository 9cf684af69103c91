"""Robust poses of many frames of one camera at once, over stacked sums.

:func:`fit_frames` minimizes a given loss by Levenberg-Marquardt; :func:`fit_each_frame` measures
the spread of every frame's residuals about its own pose, and takes the loss from it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import retract_all
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS, robust_spreads
from factors import ProjectionBlock, to_runs

Runs = NDArray[np.int64]
"""(f, 2): the first correspondence of each frame, and the one behind its last."""

_MAX_STEPS = 50  # with a start in the right basin, 4 to 8 are enough
_DAMPING, _MAX_DAMPING = 1e-5, 1e6  # relative to the diagonal
_MIN_DAMPING = 1e-12  # with less, frames that leave a direction free would be singular
_LEAST_SIZE = np.finfo(np.float64).tiny
_SMALL_STEP = 1e-10  # rad, m: below what residuals of 1e-6 px resolve
FINE, COARSE = 1e-10, 1e-3
"""Relative decrease of the cost at which a fit stops: at the optimum; as a start for another."""
DAMPING = 1e-6
"""Of the diagonal, for frames that leave a direction free."""

_OWN_STEPS = 6  # Gauss-Newton steps to a frame's own extrinsic
_MAX_STEP_RAD = 0.05  # rotation of one step, 3 degrees: beyond it the linearization does not hold
_MAX_SPREAD = 1e6  # px, in place of the infinite spread of a frame that is all behind its camera
_MIN_MATCHES = 10  # fewer residuals about a frame's own extrinsic (6 unknowns) give no spread


@dataclass(frozen=True, eq=False)
class FramePoses:
    """Frames at the least robust cost of each.

    Attributes:
        T_camera_lidar: (f, 4, 4).
        hessians: (f, 6, 6) there.
        converged: (f,) whether the fit stopped by its tolerance.
    """

    T_camera_lidar: Array
    hessians: Array
    converged: NDArray[np.bool_]


def fit_frames(
    block: ProjectionBlock, runs: Runs, T_camera_lidar: Array, *, tolerance: float = FINE
) -> FramePoses:
    """Minimize the robust cost of each frame by itself.

    Args:
        block: correspondences of one camera.
        runs: (f, 2) those of each frame.
        T_camera_lidar: (f, 4, 4) starts.
        tolerance: relative decrease of the cost at which a frame is done.
    """
    T = T_camera_lidar.copy()
    sums = block.run_sums(T, runs)
    hessians, gradients, costs = sums.hessian, sums.gradient, sums.cost
    dampings, active = np.full(len(T), _DAMPING), np.arange(len(T))
    for _ in range(_MAX_STEPS):
        steps = solve_damped(hessians[active], gradients[active], dampings[active])
        trial = retract_all(T[active], steps)
        new = block.run_sums(trial, runs[active])
        gain = costs[active] - new.cost
        better = gain >= 0
        done = better & (gain <= tolerance * costs[active])
        done |= np.abs(steps).max(axis=1, initial=0) < _SMALL_STEP
        moved = active[better]
        T[moved], costs[moved] = trial[better], new.cost[better]
        hessians[moved], gradients[moved] = new.hessian[better], new.gradient[better]
        dampings[active] *= np.where(better, 0.1, 10.0)
        np.maximum(dampings, _MIN_DAMPING, out=dampings)
        active = active[~done & (dampings[active] < _MAX_DAMPING)]
        if not len(active):
            break
    converged = dampings < _MAX_DAMPING
    converged[active] = False
    return FramePoses(T, hessians, converged)


def solve_damped(hessians: Array, gradients: Array, dampings: Array | float) -> Array:
    """(f, 6) steps to the minima of quadratic costs; a direction that is free gets no step.

    Args:
        hessians: (f, 6, 6).
        gradients: (f, 6).
        dampings: of each, or of all: what is added to the diagonal, relative to it; above 1e-15.
    """
    sizes = np.einsum("fii->fi", hessians)
    units = np.where(sizes > 0, np.maximum(sizes, _LEAST_SIZE) ** -0.5, 0.0)
    scaled = hessians * units[:, :, None] * units[:, None, :]
    np.einsum("fii->fi", scaled)[...] = 1.0 + np.reshape(dampings, (-1, 1))
    return np.asarray(-units * np.linalg.solve(scaled, (units * gradients)[:, :, None])[:, :, 0])


@dataclass(frozen=True, eq=False)
class FrameFits:
    """The frames of a camera, each at its own extrinsic.

    Attributes:
        T_camera_lidar: (f, 4, 4) each frame's own.
        counts: (f,) matches.
        spreads: (f,) of whitened residuals about the common extrinsic, from those about their own.
        spreads_px: (f,) of unweighted ones, about their own.
        hessians: (f, 6, 6) of whitened residuals there, in the tangent of T_lidar_camera.
        sizes: (n,) of the residuals there, over the frame's spread, as ``CameraBlock.all_sizes``;
            infinite where a point is not projectable.
    """

    T_camera_lidar: Array
    counts: Array
    spreads: Array
    spreads_px: Array
    hessians: Array
    sizes: Array

    @property
    def noise(self) -> Array:
        """(f,) mean square displacement of whitened pixels by the noise of the own extrinsic."""
        return 6 * self.spreads**2 / self.counts


def fit_each_frame(block: CameraBlock, T_camera_lidar: Array) -> FrameFits:
    """Fit every frame alone by damped Gauss-Newton steps, its loss as wide as its residuals spread.

    Args:
        block: of one camera.
        T_camera_lidar: (f, 4, 4) starts of its frames.
    """
    runs, T = to_runs(block.frame_edges), T_camera_lidar
    least = block.least_spreads(runs)
    for _ in range(_OWN_STEPS):
        sizes = block.all_sizes(T, runs)[1]
        spreads = np.minimum(np.maximum(robust_spreads(sizes, runs), least), _MAX_SPREAD)
        sums = block.block.run_sums(T, runs, CAUCHY_SCALE_SIGMAS * spreads)
        steps = solve_damped(sums.hessian, sums.gradient, DAMPING)
        turns = np.abs(steps[:, :3]).max(axis=1)
        steps *= np.minimum(1.0, _MAX_STEP_RAD / np.maximum(turns, 1e-12))[:, None]
        T = retract_all(T, steps)
    counts = block.frame_counts.astype(np.float64)
    spreads = _about_common_extrinsic(spreads, counts)
    return FrameFits(
        T_camera_lidar=T,
        counts=counts,
        spreads=spreads,
        spreads_px=robust_spreads(block.all_sizes(T, runs)[0], runs),
        hessians=sums.hessian,
        sizes=sizes / np.repeat(spreads, block.frame_counts),
    )


def _about_common_extrinsic(spreads: Array, counts: Array) -> Array:
    """(f,) spreads of residuals about the common extrinsic, from those about each frame's own.

    Six unknowns take their share of 2 n residuals; where they take most, the spread is at least
    that of a typical frame.
    """
    grown = spreads * np.sqrt(2 * counts / np.maximum(2 * counts - 6, 1))
    enough = counts >= _MIN_MATCHES
    typical = float(np.median(grown[enough] if enough.any() else grown))
    return np.asarray(np.where(enough, grown, np.maximum(grown, typical)))
