"""Robust poses of many frames of one camera at once, over stacked sums."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.model.pose_kernel import MAX_DAMPING, descend
from calibgraph.solver.camera_block import MIN_MATCHES
from factors import ProjectionBlock
from factors.block_sums import unpack_sums
from factors.conditioning import are_regular

Runs = NDArray[np.int64]
"""(f, 2): the first correspondence of each frame, and the one behind its last."""

_MAX_STEPS = 50  # with a start in the right basin, 4 to 8 are enough
_DAMPING = 1e-5  # relative to the diagonal, at first
FINE, COARSE = 1e-10, 1e-3
"""Relative decrease of the cost at which a fit stops: at the optimum; as a start for another."""
DAMPING = 1e-6
"""Of the diagonal, for frames that leave a direction free."""

_REFINEMENTS = 2  # the first with the inliers of PnP, the second with those of the first
_MIN_INLIER_SHARE = 0.1  # chosen, not measured
_MIN_SCALED_EIGENVALUE = 1e-9  # below it a direction is free: points on one line, or in one place


@dataclass(frozen=True, eq=False)
class FramePoses:
    """Frames at the least robust cost of each.

    Attributes:
        T_camera_lidar: (f, 4, 4).
        hessians: (f, 6, 6) there.
        found: (f,) whether the fit stopped by its tolerance; of :func:`refine_frames`, whether
            enough matches agree on it, and leave no direction of it free.
        inliers: (f,) matches that it is fitted to; of :func:`refine_frames`, within the threshold.
    """

    T_camera_lidar: Array
    hessians: Array
    found: NDArray[np.bool_]
    inliers: NDArray[np.int64]


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
    T, sums = T_camera_lidar.copy(), block.packed_run_sums(T_camera_lidar, runs)
    dampings, active = np.full(len(T), _DAMPING), np.arange(len(T))
    steps, tried, new = np.empty((len(T), 6)), np.empty_like(T), sums[:0]
    for _ in range(1 + _MAX_STEPS):
        count = descend(sums, T, dampings, active, steps, tried, new, (tolerance, math.inf))
        if not count:
            break
        new = block.packed_run_sums(tried[:count], runs[active[:count]])
    converged = dampings < MAX_DAMPING
    converged[active[:count]] = False
    return FramePoses(T, unpack_sums(sums).hessian, converged, runs[:, 1] - runs[:, 0])


def move_damped(
    sums: Array, T_camera_lidar: Array, *, damping: float = DAMPING, most_rad: float = math.inf
) -> tuple[Array, Array]:
    """Poses at the minima of quadratic costs; a direction that is free gets no step.

    Args:
        sums: (f, 28) of each pose, as ``ProjectionBlock.packed_run_sums``.
        T_camera_lidar: (f, 4, 4).
        damping: what is added to the diagonal, relative to it.
        most_rad: that a step turns about an axis; longer ones are shortened.

    Returns:
        (f, 4, 4) T_camera_lidar; (f, 6) the steps, in the tangent of T_lidar_camera.
    """
    count = len(sums)
    steps, moved = np.empty((count, 6)), np.empty((count, 4, 4))
    T, dampings = np.array(T_camera_lidar), np.full(count, damping)  # which can be written
    descend(sums, T, dampings, np.arange(count), steps, moved, sums[:0], (0.0, most_rad))
    return moved, steps


def refine_frames(
    block: ProjectionBlock, runs: Runs, T_camera_lidar: Array, config: Config
) -> FramePoses:
    """Re-select each frame's inliers with the full lens model and refine on them, a few times.

    Args:
        block: of all frames, with all their matches, unweighted.
        runs: (f, 2) those of each frame, one behind the other.
        T_camera_lidar: (f, 4, 4) starts.
        config: ``pnp_threshold_px``.
    """
    least = np.maximum(MIN_MATCHES, _MIN_INLIER_SHARE * (runs[:, 1] - runs[:, 0]))
    found = np.ones(len(runs), dtype=np.bool_)
    for _ in range(_REFINEMENTS):
        residuals, projectable = block.run_residuals(T_camera_lidar, runs)
        squared = residuals[:, 0] ** 2 + residuals[:, 1] ** 2
        inlier = projectable & (squared < config.pnp_threshold_px**2)
        places = np.concatenate([[0], np.cumsum(inlier)])[runs]
        inliers = places[:, 1] - places[:, 0]
        found &= inliers >= least
        some = block.select(inlier).rescale(scale=config.pnp_threshold_px / 2)
        places[~found] = 0
        fit = fit_frames(some, places, T_camera_lidar)
        T_camera_lidar = fit.T_camera_lidar
        found &= are_regular(fit.hessians, _MIN_SCALED_EIGENVALUE)
    return FramePoses(T_camera_lidar, fit.hessians, found, inliers)
