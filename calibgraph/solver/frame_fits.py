"""The extrinsic of every frame by itself, and the spread of its residuals."""

from dataclasses import dataclass, replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import retract_all
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.frame_poses import solve_damped
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS, robust_spreads
from factors import to_runs

DAMPING = 1e-6
"""Of the diagonal, for frames that leave a direction free."""

_OWN_STEPS = 6  # Gauss-Newton steps to a frame's own extrinsic
_MAX_STEP_RAD = 0.05  # rotation of one step, 3 degrees: beyond it the linearization does not hold
_MAX_SPREAD = 1e6  # px, in place of the infinite spread of a frame that is all behind its camera
_MIN_MATCHES = 10  # fewer residuals about a frame's own extrinsic (6 unknowns) give no spread


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
    """Fit every frame alone, robustly, by damped Gauss-Newton steps.

    Args:
        block: of one camera.
        T_camera_lidar: (f, 4, 4) starts of its frames.
    """
    fits = fit_alone(block, T_camera_lidar)
    spreads = about_common_extrinsic(fits.spreads, fits.counts)
    each = np.repeat(spreads, fits.counts.astype(np.int64))
    return replace(fits, spreads=spreads, sizes=fits.sizes / each)


def fit_alone(block: CameraBlock, T_camera_lidar: Array) -> FrameFits:
    """As :func:`fit_each_frame`, with spreads about the frames' own extrinsics, sizes unscaled."""
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
    counts = runs[:, 1] - runs[:, 0]
    return FrameFits(
        T_camera_lidar=T,
        counts=counts.astype(np.float64),
        spreads=spreads,
        spreads_px=robust_spreads(block.all_sizes(T, runs)[0], runs),
        hessians=sums.hessian,
        sizes=sizes,
    )


def about_common_extrinsic(spreads: Array, counts: Array) -> Array:
    """(f,) spreads of residuals about the common extrinsic, from those about each frame's own.

    Six unknowns take their share of 2 n residuals; where they take most, the spread is at least
    that of a typical frame.
    """
    grown = spreads * np.sqrt(2 * counts / np.maximum(2 * counts - 6, 1))
    enough = counts >= _MIN_MATCHES
    typical = float(np.median(grown[enough] if enough.any() else grown))
    return np.asarray(np.where(enough, grown, np.maximum(grown, typical)))
