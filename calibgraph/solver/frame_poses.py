"""Robust poses of many frames of one camera at once: Levenberg-Marquardt over stacked sums."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import retract_all
from factors import ProjectionBlock

Runs = NDArray[np.int64]
"""(f, 2): the first correspondence of each frame, and the one behind its last."""

_MAX_STEPS = 50  # with a start in the right basin, 4 to 8 are enough
_DAMPING, _MAX_DAMPING = 1e-5, 1e6  # relative to the diagonal
_MIN_DAMPING = 1e-12  # with less, frames that leave a direction free would be singular
_LEAST_SIZE = np.finfo(np.float64).tiny
_SMALL_STEP = 1e-10  # rad, m: below what residuals of 1e-6 px resolve
FINE, COARSE = 1e-10, 1e-3
"""Relative decrease of the cost at which a fit stops: at the optimum; as a start for another."""


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
