"""Quadratic approximations of blocks of matches, and their sums over frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import pose_rows
from calibgraph.solver.camera_block import BlockResiduals
from calibgraph.solver.curvature import robust_hessian
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.tracking.epoch_summary import STRENGTHS, gain_of_walk, step_between
from calibgraph.tracking.live_frames import Epoch, LiveFrame
from calibgraph.tracking.state import State, block_diagonal
from factors import ProjectionBlock

Array = NDArray[np.float64]


class Quadratic(NamedTuple):
    """Half the cost of some matches of one camera, near its reference.

    Attributes:
        hessian: (6, 6) true one.
        gradient: (6,) at the reference.
        reweighted: (6, 6) Hessian of the matches by their weights in the loss: it is positive
            semidefinite, of however few.
    """

    hessian: Array
    gradient: Array
    reweighted: Array


def quadratic(
    residuals: BlockResiduals,
    inliers: NDArray[np.bool_],
    scale: ResidualScale,
    T_lidar_camera: gtsam.Pose3,
    reference: gtsam.Pose3,
) -> Quadratic:
    """The quadratic approximation of one frame's cost for a camera.

    Args:
        residuals: of its matches at T_lidar_camera.
        inliers: (m,) which of them are within the gate.
        scale: of the residuals.
        T_lidar_camera: near the minimum.
        reference: T_lidar_camera at which the gradient is taken.
    """
    block = residuals.block.select(inliers).with_scale(scale)
    hessian = true_hessian(residuals, block, scale, T_lidar_camera)
    sums = block.sums(T_lidar_camera)
    gradient = sums.gradient + hessian @ step_between(T_lidar_camera, reference)
    return Quadratic(hessian, gradient, sums.hessian)


def true_hessian(
    residuals: BlockResiduals,
    block: ProjectionBlock,
    scale: ResidualScale,
    T_lidar_camera: gtsam.Pose3,
) -> Array:
    """(6, 6) of the robust cost of the matches in the gate, which moves with T_lidar_camera."""
    return robust_hessian(block, T_lidar_camera) + residuals.gate_hessian(scale)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Sums of all cameras' quadratics at one time, about the references.

    Attributes:
        hessian: (n, 6, 6) per camera: projections tie no two cameras.
        gradient: (n, 6).
        scatter: (6 n, 6 n).
        frames: (n,) effective numbers of frames.
    """

    hessian: Array
    gradient: Array
    scatter: Array
    frames: Array

    @staticmethod
    def from_summaries(state: State) -> Posterior:
        """The summaries of older epochs."""
        summaries = [camera.summary for camera in state.cameras]
        scatter = state.cross.copy()
        for place, summary in enumerate(summaries):
            rows = pose_rows(place)
            scatter[rows, rows] = summary.scatter[summary.walk]
        return Posterior(
            np.array([m.hessian[m.walk] for m in summaries]),
            np.array([m.gradient[m.walk] for m in summaries]),
            scatter,
            np.array([m.frames[m.walk] for m in summaries]),
        )

    def add(self, frames: Iterable[LiveFrame], steps: Array) -> Posterior:
        """The sums with frames added.

        Args:
            frames: that share one extrinsic.
            steps: (n, 6) from the references to the estimate, where the gradients are taken.
        """
        listed = list(frames)
        if not listed:
            return self
        hessian = np.array([frame.hessian for frame in listed])
        gradient = np.array([frame.gradient for frame in listed])
        scores = gradient + np.einsum("fnij,nj->fni", hessian, steps)
        flat = scores.reshape(len(listed), -1)
        seen = np.array([[c in frame.raw for c in range(len(steps))] for frame in listed])
        return Posterior(
            self.hessian + hessian.sum(axis=0),
            self.gradient + gradient.sum(axis=0),
            self.scatter + flat.T @ flat,
            self.frames + seen.sum(axis=0),
        )

    def propagate(self, state: State, frames: int) -> Posterior:
        """The sums after the random walk of an epoch of so many frames."""
        if not any(camera.summary.walk for camera in state.cameras):
            return self
        gains, walked = [], []
        for place, camera in enumerate(state.cameras):
            strength = STRENGTHS[camera.summary.walk]
            variance = strength**2 * state.walk_variance(frames)
            gains.append(gain_of_walk(self.hessian[place], variance / state.overconfidence(place)))
            walked.append(variance)
        gain = np.array(gains)
        hessian = gain @ self.hessian
        hessian = (hessian + hessian.transpose(0, 2, 1)) / 2
        whole, after = block_diagonal(gain), block_diagonal(hessian)
        return Posterior(
            hessian,
            np.einsum("nij,nj->ni", gain, self.gradient),
            whole @ self.scatter @ whole.T + after @ np.diag(np.ravel(walked)) @ after,
            self.frames * np.trace(gain, axis1=1, axis2=2) / 6,
        )

    def step(self, camera: int) -> Array | None:
        """(6,) from a camera's reference to the minimum of its sums; None if undetermined."""
        if not is_determined(self.hessian[camera]):
            return None
        return np.linalg.solve(self.hessian[camera], -self.gradient[camera])


def posterior(state: State, before: int | None = None) -> Posterior:
    """The sums over the summaries and all live frames, or those before a frame's number."""
    sums = closed_posterior(state, before)
    return with_open_epoch(sums, state, before)


def closed_posterior(state: State, before: int | None = None) -> Posterior:
    """The same without the frames of the open epoch."""
    sums, steps = Posterior.from_summaries(state), steps_of(state)
    for epoch in state.epochs[:-1]:
        sums = sums.add(_until(epoch, before), steps).propagate(state, len(epoch.frames))
    return sums


def posteriors_before_epochs(state: State) -> Iterator[tuple[int, Posterior]]:
    """Per live epoch but the first, its place and the sums over the frames before it.

    As ``posterior(state, number of its first frame)``, each frame added once.
    """
    sums, steps = Posterior.from_summaries(state), steps_of(state)
    for place, epoch in enumerate(state.epochs[:-1]):
        sums = sums.add(epoch.frames, steps).propagate(state, len(epoch.frames))
        before = sums
        for later in state.epochs[place + 1 : -1]:
            before = before.propagate(state, len(later.frames))
        yield place + 1, before


def with_open_epoch(sums: Posterior, state: State, before: int | None = None) -> Posterior:
    """The sums over closed epochs with the frames of the open one added."""
    return sums.add(_until(state.epochs[-1], before), steps_of(state))


def steps_of(state: State) -> Array:
    """(n, 6) from the references to the tracker's own estimates."""
    return np.array([*map(step_between, state.references, state.T_lidar_camera)])


def _until(epoch: Epoch, number: int | None) -> list[LiveFrame]:
    return [frame for frame in epoch.frames if number is None or frame.number < number]


def inverse(matrices: Array) -> Array:
    """Inverses of (n, 6, 6) matrices."""
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def is_determined(hessian: Array) -> bool:
    """Whether all six directions are determined."""
    diagonal = np.diag(hessian)
    if not (diagonal > 0).all():
        return False
    units = np.sqrt(diagonal)
    return bool(np.linalg.eigvalsh(hessian / np.outer(units, units))[0] > _LEAST_EIGENVALUE)


_LEAST_EIGENVALUE = 1e-9  # of the unit-diagonal Hessian: rounding noise is near 1e-15
