"""What all frames until now show of each camera, all matches taken for independent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.objective import join
from calibgraph.graph.variables import camera_key
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.camera_block import BlockResiduals, CameraBlock
from calibgraph.solver.curvature import convex_hessian, robust_hessian
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.tracking.epoch_summary import STRENGTHS
from calibgraph.tracking.live_frames import Epoch
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, step_between
from factors import ProjectionBlock

Array = NDArray[np.float64]

_STEPS = 2  # of Gauss-Newton on quadratics: the second is of rounding, but for priors far away


def sums_of_frame(
    residuals: BlockResiduals,
    inliers: NDArray[np.bool_],
    scale: ResidualScale,
    reference: gtsam.Pose3,
) -> Sums:
    """The sums of one frame's matches of a camera, linearized where their residuals are.

    Args:
        residuals: of its matches, near the minimum.
        inliers: (m,) which of them are within the gate.
        scale: of the residuals.
        reference: T_lidar_camera at which the gradient is taken.
    """
    pose = residuals.T_lidar_camera
    block = residuals.block.select(inliers).with_scale(scale)
    hessian, sums = true_hessian(residuals, block, scale), block.sums(pose)
    return Sums(
        hessian,
        sums.gradient + hessian @ step_between(pose, reference),
        sums.hessian,
        sums.gradient,
        np.outer(sums.gradient, sums.gradient),
        np.array(1.0),
        np.array(float(len(block))),
    )


def equation_5(
    priors: gtsam.NonlinearFactorGraph, references: Sequence[gtsam.Pose3], sums: Sums
) -> gtsam.NonlinearFactorGraph:
    """Eq. 5 of the paper: priors, and (n,) sums of all matches as a quadratic per camera."""
    graph, at = join(priors), gtsam.Values()
    for camera, reference in enumerate(references):
        own, key = sums[camera], camera_key(camera)
        if own.hessian.any():
            at.insert(key, reference)
            hessian = convex_hessian(own.hessian, own.reweighted)
            factor = gtsam.HessianFactor(key, hessian, -own.gradient, 0.0)
            graph.add(gtsam.LinearContainerFactor(factor, at))
    return graph


def minimum(
    graph: gtsam.NonlinearFactorGraph, start: Sequence[gtsam.Pose3]
) -> tuple[gtsam.Pose3, ...]:
    """T_lidar_camera of all cameras at the minimum of :func:`equation_5`, by Gauss-Newton."""
    values, keys = gtsam.Values(), range(len(start))
    for camera in keys:
        values.insert(camera_key(camera), start[camera])
    for _ in range(_STEPS):
        values = values.retract(graph.linearize(values).optimize())
    return tuple(values.atPose3(camera_key(camera)) for camera in keys)


def sums_of_matches(
    block: CameraBlock, scale: ResidualScale, T_lidar_camera: gtsam.Pose3, reference: gtsam.Pose3
) -> Sums:
    """Hessian by their weights, and gradient at a reference, of matches in and out of the gate."""
    here = block.with_scale(scale).sums(T_lidar_camera)
    sums = replace(Sums.zeros(), hessian=here.hessian, gradient=here.gradient)
    return sums.shift_reference(step_between(T_lidar_camera, reference))


def true_hessian(residuals: BlockResiduals, block: ProjectionBlock, scale: ResidualScale) -> Array:
    """(6, 6) of the robust cost of the matches in the gate, which moves with the extrinsic."""
    return robust_hessian(block, residuals.T_lidar_camera) + residuals.gate_hessian(scale)


def posterior(state: State, before: int | None = None) -> Sums:
    """(n,) sums over all frames, or those before a frame's number."""
    return closed_posterior(state, before) + _until(state.epochs[-1], before)


def closed_posterior(state: State, before: int | None = None) -> Sums:
    """The same without the frames of the open epoch."""
    sums = _summaries(state)
    for epoch in state.epochs[:-1]:
        sums = _after_epoch(state, sums + _until(epoch, before), epoch)
    return sums


def posteriors_before_epochs(state: State) -> Iterator[tuple[int, Sums]]:
    """Per live epoch but the first, its place and the sums over the frames before it."""
    sums = _summaries(state)
    for place, epoch in enumerate(state.epochs[:-1]):
        sums = _after_epoch(state, sums + epoch.sums, epoch)
        before = sums
        for later in state.epochs[place + 1 : -1]:
            before = _after_epoch(state, before, later)
        yield place + 1, before


def split_halves(state: State) -> Sums:
    """(n, 2) sums over every other closed epoch; those of the open one are the next half's."""
    halves = Sums.stack([one.summary.halves for one in state.cameras])
    for age, epoch in enumerate(state.epochs[:-1]):
        halves = halves + in_its_half(state, epoch, age)
    return halves


def in_its_half(state: State, epoch: Epoch, age: int) -> Sums:
    """(n, 2) the sums of a live epoch, so many after the oldest, in the half that has it."""
    half = np.array([one.summary.next_half + age for one in state.cameras])
    weights: Array = np.eye(2)[half % 2]
    return epoch.sums[:, None] * weights


def estimates_of_halves(state: State, halves: Sums, camera: int) -> tuple[Array, Array] | None:
    """Two (4, 4) T_camera_lidar of a camera; None if one of them is undetermined."""
    first, second = (halves[camera].step(half) for half in range(2))
    if first is None or second is None:
        return None
    reference = state.references[camera]
    return to_T_camera_lidar(reference.retract(first)), to_T_camera_lidar(reference.retract(second))


def steps_of(state: State) -> Array:
    """(n, 6) from the references to the tracker's own estimates."""
    return np.array([*map(step_between, state.references, state.T_lidar_camera)])


def _summaries(state: State) -> Sums:
    return Sums.stack([one.summary.selected for one in state.cameras])


def _after_epoch(state: State, sums: Sums, epoch: Epoch) -> Sums:
    """The sums after the random walk of an epoch."""
    strengths = STRENGTHS[[one.summary.walk for one in state.cameras]]
    if not strengths.any():
        return sums
    variance = np.outer(strengths**2, state.walk_variance(len(epoch.frames)))
    overconfidence = [state.overconfidence(camera) for camera in range(len(strengths))]
    return sums.after_walk(variance, np.array(overconfidence))[0]


def _until(epoch: Epoch, number: int | None) -> Sums:
    if number is None:
        return epoch.sums
    earlier = [frame.sums for frame in epoch.frames if frame.number < number]
    return Sums.stack([Sums.zeros(len(epoch.T_lidar_camera)), *earlier]).total()
