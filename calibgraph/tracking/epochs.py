"""The end of an epoch: the oldest live one is summarized, a new one begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.camera_block import MIN_MATCHES, merge
from calibgraph.tracking.drift import follow_drift, report_drift
from calibgraph.tracking.epoch_summary import step_between
from calibgraph.tracking.events import Event
from calibgraph.tracking.live_frames import Epoch
from calibgraph.tracking.posterior import true_hessian
from calibgraph.tracking.state import CameraState, State, block_diagonal

Array = NDArray[np.float64]


def close_epoch(
    state: State, estimates: Sequence[tuple[gtsam.Pose3, ...]]
) -> tuple[State, list[Event]]:
    """The state with its open epoch closed and a new one begun.

    Args:
        state: before.
        estimates: the newest T_lidar_camera estimates, per live epoch and camera.
    """
    epochs = tuple(
        replace(epoch, T_lidar_camera=of_epoch)
        for epoch, of_epoch in zip(state.epochs, estimates, strict=True)
    )
    state = replace(state, epochs=epochs)
    if len(epochs) > state.config.tracking.live_epochs:
        state = _summarize_oldest(state)
    state = _with_references(state, state.T_lidar_camera)
    cameras = tuple(
        replace(camera_state, scale=camera_state.residuals.scale(state.config))
        if camera_state.started
        else camera_state
        for camera_state in state.cameras
    )
    state = replace(state, cameras=cameras)
    epochs = tuple(_regate(state, epoch) for epoch in state.epochs)
    return report_drift(replace(state, epochs=(*epochs, Epoch((), state.T_lidar_camera))))


def _regate(state: State, epoch: Epoch) -> Epoch:
    """The epoch with its frames gated at its newest estimate."""
    T_camera_lidar = [*map(to_T_camera_lidar, epoch.T_lidar_camera)]
    gates_px = [camera_state.scale.gate_px for camera_state in state.cameras]
    frames = []
    for frame in epoch.frames:
        inliers = dict(frame.inliers)
        for camera, raw in frame.raw.items():
            rows = raw.within_gate(T_camera_lidar[camera], gates_px[camera])
            if np.count_nonzero(rows) >= MIN_MATCHES:
                inliers[camera] = rows
        frames.append(replace(frame, inliers=inliers))
    return replace(epoch, frames=tuple(frames))


def _with_references(state: State, references: tuple[gtsam.Pose3, ...]) -> State:
    """The state with its sums about other references."""
    steps = np.array([*map(step_between, state.references, references)])
    cameras = tuple(
        replace(camera_state, summary=camera_state.summary.shift_reference(step))
        for camera_state, step in zip(state.cameras, steps, strict=True)
    )
    drift = state.drift
    if drift is not None:
        anchors = zip(drift.anchors, steps, strict=True)
        drift = replace(
            drift, anchors=tuple(anchor.shift_reference(step) for anchor, step in anchors)
        )
    epochs = tuple(
        replace(
            epoch,
            frames=tuple(
                replace(f, gradient=f.gradient + np.einsum("nij,nj->ni", f.hessian, steps))
                for f in epoch.frames
            ),
        )
        for epoch in state.epochs
    )
    return replace(state, cameras=cameras, epochs=epochs, references=references, drift=drift)


@dataclass(frozen=True, eq=False)
class _EpochSums:
    """Sums of an epoch's matches, gated anew, about a camera's reference.

    Attributes:
        hessian: (6, 6).
        gradient: (6,) at the reference.
        scores: (f, 6) gradients at the estimate of all its frames; zero where there is none.
        frames: how many have matches.
    """

    hessian: Array
    gradient: Array
    scores: Array
    frames: int


def _epoch_sums(state: State, epoch: Epoch, camera: int) -> _EpochSums:
    numbers = np.array([frame.number for frame in epoch.frames])
    scores = np.zeros((len(numbers), 6))
    raw = [frame.raw[camera] for frame in epoch.frames if camera in frame.raw]
    nothing = _EpochSums(np.zeros((6, 6)), np.zeros(6), scores, 0)
    if not raw:
        return nothing
    T_lidar_camera, scale = epoch.T_lidar_camera[camera], state.cameras[camera].scale
    everything = merge(raw)
    residuals = everything.at(to_T_camera_lidar(T_lidar_camera))
    inliers = everything.select(residuals.inliers(scale))
    if len(inliers.frame) < MIN_MATCHES:
        return nothing
    block = inliers.with_scale(scale)
    own, starts = np.unique(inliers.frame, return_index=True)
    gradients = block.frame_sums(T_lidar_camera, np.append(starts, len(inliers.frame))).gradient
    scores[np.searchsorted(numbers, own)] = gradients
    hessian = true_hessian(residuals, block, scale, T_lidar_camera)
    to_reference = step_between(T_lidar_camera, state.references[camera])
    gradient = gradients.sum(axis=0) + hessian @ to_reference
    return _EpochSums(hessian, gradient, scores, len(own))


def _summarize_oldest(state: State) -> State:
    """The state with its oldest epoch added to the summaries."""
    epoch, *younger = state.epochs
    sums = [_epoch_sums(state, epoch, camera) for camera in range(len(state.cameras))]
    update_evidence = [_update_evidence(state, camera, s) for camera, s in enumerate(sums)]
    state = replace(state, cameras=tuple(update_evidence))
    state = _select_walks(state)
    gains, cameras = [], []
    for camera, (camera_state, s) in enumerate(zip(state.cameras, sums, strict=True)):
        summary = camera_state.summary
        if s.frames:
            summary = summary.add(s.hessian, s.gradient, s.scores.T @ s.scores, s.frames)
        summary, gain = summary.propagate(
            state.walk_variance(len(epoch.frames)), state.overconfidence(camera)
        )
        cameras.append(replace(camera_state, summary=summary))
        gains.append(gain)
    scores = np.hstack([s.scores for s in sums])
    cross, gain = state.cross + _between_cameras(scores), block_diagonal(np.array(gains))
    return replace(
        state, cameras=tuple(cameras), cross=gain @ cross @ gain.T, epochs=tuple(younger)
    )


def _between_cameras(scores: Array) -> Array:
    """(6 n, 6 n) scatter of (f, 6 n) gradients; 0 in the blocks of one camera."""
    scatter: Array = scores.T @ scores
    for rows in range(0, len(scatter), 6):
        scatter[rows : rows + 6, rows : rows + 6] = 0.0
    return scatter


def _update_evidence(state: State, camera: int, sums: _EpochSums) -> CameraState:
    """The camera with the evidence of its walks updated by how well they predict an epoch.

    The scatter of epochs is updated here too: by now, a move within the epoch has been detected.
    """
    camera_state, alone = state.cameras[camera], state.scatter_of_frames(camera)
    noise = state.frame_noise(camera)
    if noise is None or alone is None or not sums.frames:
        return camera_state
    score = sums.scores.sum(axis=0)
    groups = tuple(one.add(score, sums.frames, alone) for one in camera_state.groups)
    summary = camera_state.summary.update_evidence(sums.hessian, sums.gradient, noise * sums.frames)
    return replace(camera_state, summary=summary, groups=groups)


def _select_walks(state: State) -> State:
    """The state with each camera's walk selected by the evidence."""
    for camera, camera_state in enumerate(state.cameras):
        summary = camera_state.summary.select_walk()
        if summary.walk > 0 == camera_state.summary.walk:
            state = follow_drift(state, camera, summary.walk)
        else:
            state = state.with_camera(camera, replace(camera_state, summary=summary))
    return state
