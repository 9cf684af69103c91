"""The extrinsic of every frame by itself, and the spread of its residuals."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS, robust_spread

Array = NDArray[np.float64]

_OWN_STEPS = 6  # Gauss-Newton steps to a frame's own extrinsic
_MAX_STEP_RAD = 0.05  # rotation of one step, 3 degrees: beyond it the linearization does not hold
_DAMPING = 1e-6  # of the diagonal, for a frame that leaves a direction free
_MAX_SPREAD = 1e6  # px, in place of the infinite spread of a frame that is all behind its camera
_MIN_MATCHES = 10  # fewer residuals about a frame's own extrinsic (6 unknowns) give no spread


@dataclass(frozen=True, eq=False)
class FrameFits:
    """The frames of a camera, each at its own extrinsic.

    Attributes:
        T_lidar_camera: (f,) each frame's own.
        counts: (f,) matches.
        spreads: (f,) of whitened residuals about the common extrinsic, from those about their own.
        spreads_px: (f,) of unweighted ones, about their own.
        hessians: (f, 6, 6) of whitened residuals there.
        sizes: (n,) of the residuals there, over the frame's spread, as ``BlockResiduals.sizes``.
    """

    T_lidar_camera: tuple[gtsam.Pose3, ...]
    counts: Array
    spreads: Array
    spreads_px: Array
    hessians: Array
    sizes: Array

    @property
    def noise(self) -> Array:
        """(f,) mean square displacement of whitened pixels by the noise of the own extrinsic."""
        return 6 * self.spreads**2 / self.counts


def fit_each_frame(parts: list[CameraBlock], starts: list[Array]) -> FrameFits:
    """Fit every frame alone, robustly.

    Args:
        parts: the correspondences of each frame.
        starts: (4, 4) T_camera_lidar of each.
    """
    fits = [_fit_frame(part, start) for part, start in zip(parts, starts, strict=True)]
    counts = np.array([len(part.frame) for part in parts])
    spreads = _about_common_extrinsic(np.array([fit.spread for fit in fits]), counts)
    return FrameFits(
        T_lidar_camera=tuple(fit.T_lidar_camera for fit in fits),
        counts=counts.astype(np.float64),
        spreads=spreads,
        spreads_px=np.array([fit.spread_px for fit in fits]),
        hessians=np.array([fit.hessian for fit in fits]),
        sizes=np.concatenate([fit.sizes for fit in fits]) / np.repeat(spreads, counts),
    )


@dataclass(frozen=True, eq=False)
class _FrameFit:
    """One frame at its own T_lidar_camera; spreads, (6, 6) and (n,) as in :class:`FrameFits`."""

    T_lidar_camera: gtsam.Pose3
    spread: float
    spread_px: float
    hessian: Array
    sizes: Array


def _fit_frame(part: CameraBlock, start: Array) -> _FrameFit:
    """Fit the T_lidar_camera of one frame by damped Gauss-Newton steps."""
    T_lidar_camera = to_T_lidar_camera(start)
    for _ in range(_OWN_STEPS):
        sizes = _whitened_sizes(part, T_lidar_camera)
        spread = robust_spread(sizes[np.isfinite(sizes)])
        spread = min(max(spread, part.least_spread), _MAX_SPREAD)
        sums = replace(part.block, scale=CAUCHY_SCALE_SIGMAS * spread).sums(T_lidar_camera)
        step = -np.linalg.solve(damped(sums.hessian), sums.gradient)
        step *= min(1.0, _MAX_STEP_RAD / max(float(np.abs(step[:3]).max()), 1e-12))
        T_lidar_camera = T_lidar_camera.retract(step)
    spread_px = robust_spread(part.sizes(to_T_camera_lidar(T_lidar_camera))[0])
    return _FrameFit(T_lidar_camera, spread, spread_px, sums.hessian, sizes)


def _about_common_extrinsic(spreads: Array, counts: NDArray[np.int_]) -> Array:
    """(f,) spreads of residuals about the common extrinsic, from those about each frame's own.

    Six unknowns take their share of 2 n residuals; where they take most, the spread is at least
    that of a typical frame.
    """
    grown = spreads * np.sqrt(2 * counts / np.maximum(2 * counts - 6, 1))
    enough = counts >= _MIN_MATCHES
    typical = float(np.median(grown[enough] if enough.any() else grown))
    return np.asarray(np.where(enough, grown, np.maximum(grown, typical)))


def damped(hessian: Array) -> Array:
    """The Hessian with a little on its diagonal: invertible, though it leaves directions free."""
    least = np.finfo(float).tiny
    return np.asarray(hessian + np.diag(_DAMPING * np.diag(hessian) + least))


def _whitened_sizes(part: CameraBlock, T_lidar_camera: gtsam.Pose3) -> Array:
    """(n,) sizes of whitened residuals, infinite where a point is not projectable."""
    at = part.at(to_T_camera_lidar(T_lidar_camera))
    sizes = np.full(len(part.frame), np.inf)
    sizes[at.projectable] = at.sizes[1]
    return sizes
