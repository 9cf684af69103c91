"""Robust poses of many frames of one camera at once, over stacked sums.

:func:`fit_frames` minimizes a given loss by Levenberg-Marquardt; :func:`fit_each_frame` measures
the spread of every frame's residuals about its own pose, and takes the loss from it.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.pose_kernel import MAX_DAMPING, descend
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS, CUT, robust_spreads
from factors import ProjectionBlock, to_runs
from factors.arrays import unpack_sums

Runs = NDArray[np.int64]
"""(f, 2): the first correspondence of each frame, and the one behind its last."""

_MAX_STEPS = 50  # with a start in the right basin, 4 to 8 are enough
_DAMPING = 1e-5  # relative to the diagonal, at first
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
    return FramePoses(T, unpack_sums(sums).hessian, converged)


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


def fit_each_frame(block: CameraBlock, own: Array, common: Array) -> FrameFits:
    """Fit every frame alone by damped Gauss-Newton steps, its loss as wide as its residuals spread.

    Args:
        block: of one camera.
        own: (f, 4, 4) T_camera_lidar of its frames, by PnP of each.
        common: (4, 4) T_camera_lidar that a frame starts from if its own fits worse.
    """
    runs = to_runs(block.frame_edges)
    least, T = block.least_spreads(runs), np.broadcast_to(common, own.shape)
    at_own, at_common = (robust_spreads(block.all_sizes(each, runs)[1], runs) for each in (own, T))
    T = np.where((at_own <= at_common)[:, None, None], own, T)
    for _ in range(_OWN_STEPS):
        sizes = block.all_sizes(T, runs)[1]
        spreads = np.minimum(np.maximum(robust_spreads(sizes, runs), least), _MAX_SPREAD)
        sums = block.block.packed_run_sums(T, runs, CAUCHY_SCALE_SIGMAS * spreads)
        T = move_damped(sums, T, most_rad=_MAX_STEP_RAD)[0]
    counts = block.frame_counts.astype(np.float64)
    inside = np.add.reduceat(sizes <= CUT * np.repeat(spreads, block.frame_counts), runs[:, 0])
    spreads = _about_common_extrinsic(spreads, counts, inside)
    return FrameFits(
        T_camera_lidar=T,
        counts=counts,
        spreads=spreads,
        spreads_px=robust_spreads(block.all_sizes(T, runs)[0], runs),
        hessians=unpack_sums(sums).hessian,
        sizes=sizes / np.repeat(spreads, block.frame_counts),
    )


def _about_common_extrinsic(spreads: Array, counts: Array, inside: Array) -> Array:
    """(f,) spreads of residuals about the common extrinsic, from those about each frame's own.

    Six unknowns take their share of 2 n residuals; where they take most of the ``inside``, from
    which a spread is measured, it is at least that of a typical frame: among outliers there is
    always a pose that fits a few matches exactly.
    """
    grown = spreads * np.sqrt(2 * counts / np.maximum(2 * counts - 6, 1))
    enough = inside >= _MIN_MATCHES
    typical = float(np.median(grown[enough] if enough.any() else grown))
    return np.asarray(np.where(enough, grown, np.maximum(grown, typical)))
