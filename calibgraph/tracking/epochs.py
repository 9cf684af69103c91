"""The end of an epoch: the oldest live one is summarized, a new one begins."""

from __future__ import annotations

from collections.abc import Sequence
from operator import add

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import pose_rows, to_T_camera_lidar
from calibgraph.solver.matches import merge
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.drift import follow_drift, report_drift
from calibgraph.tracking.epoch_summary import STRENGTHS
from calibgraph.tracking.events import Event
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.live_frames import Epoch, LiveFrame, inliers_of
from calibgraph.tracking.place_sums import sums_by_place
from calibgraph.tracking.regate import regate
from calibgraph.tracking.state import State
from calibgraph.tracking.steps import shift_between
from calibgraph.tracking.sums import Sums, step_between, sums_of_matches
from factors import to_runs


def close_epoch(state: State) -> tuple[State, list[Event]]:
    """The state with its open epoch closed and a new one begun.

    A camera that drifts keeps the estimate of each epoch; any other has the newest in all of them.
    """
    epochs = tuple(_at_newest(state, epoch) for epoch in state.epochs)
    state = changed(state, epochs=epochs)
    if len(epochs) > state.config.tracking.live_epochs:
        state = _summarize_oldest(state)
    state = _with_references(state, state.T_lidar_camera)
    cameras = tuple(
        changed(one, scale=one.residuals.scale(state.config)) if one.started else one
        for one in state.cameras
    )
    state = changed(state, cameras=cameras)
    state = regate(state)
    epochs = state.epochs
    following = Epoch.empty(state.T_lidar_camera)
    epochs = (*epochs[:-1], _with_distortion(state, epochs[-1]), following)
    return report_drift(changed(state, epochs=epochs))


def _at_newest(state: State, epoch: Epoch) -> Epoch:
    estimates = zip(state.cameras, epoch.T_lidar_camera, state.T_lidar_camera, strict=True)
    poses = tuple(own if one.summary.walk else newest for one, own, newest in estimates)
    return changed(epoch, T_lidar_camera=poses)


def _with_distortion(state: State, epoch: Epoch) -> Epoch:
    """The epoch with the evidence of the scan distortion, if its size is stated."""
    if any(state.findings.bend_sigmas):
        for camera, one in enumerate(state.cameras):
            epoch = epoch.with_distortion(camera, one.scale)
    return epoch


def _with_references(state: State, references: tuple[gtsam.Pose3, ...]) -> State:
    """The state with its sums about other references, but those of live frames."""
    steps = np.array([*map(step_between, state.references, references)])
    cameras = tuple(
        changed(camera_state, summary=camera_state.summary.shift_reference(step))
        for camera_state, step in zip(state.cameras, steps, strict=True)
    )
    drift = state.drift
    if drift is not None:
        drift = changed(drift, anchors=drift.anchors.shift_reference(steps))
    places = state.places.shift_reference(steps)
    return changed(state, cameras=cameras, references=references, places=places, drift=drift)


def _summarize_oldest(state: State) -> State:
    """The state with its oldest epoch added to the summaries."""
    epoch, *younger = state.epochs
    drifted = [one.summary.walk > 0 for one in state.cameras]
    by_places = shift_between(state, (), epoch.frames)
    cameras = range(len(state.cameras))
    evidence = tuple(_update_evidence(state, camera, epoch, by_places) for camera in cameras)
    state = _select_walks(changed(state, cameras=evidence))
    for camera, one in enumerate(state.cameras):
        summary = one.summary
        if epoch.sums.frames[camera]:
            summary = summary.add(epoch.sums[camera], _ungated(state, epoch, camera))
        variance = state.walk_variance(STRENGTHS, len(epoch.frames))
        summary = summary.propagate(variance, state.overconfidence(camera))
        state = state.with_camera(camera, changed(one, summary=summary))
    distortion = tuple(map(add, state.distortion, epoch.distortion))
    state = changed(state, epochs=tuple(younger), distortion=distortion)
    return _with_places(state, epoch, drifted)


def _at_places(state: State, epoch: Epoch) -> list[LiveFrame]:
    """The frames of an epoch, linearized at the poses of their places at the optimum."""
    frames = [changed(frame, sums=frame.sums.copy()) for frame in epoch.frames]
    for camera, (estimate, reference) in enumerate(
        zip(epoch.T_lidar_camera, state.references, strict=True)
    ):
        own = [frame for frame in frames if camera in frame.raw]
        inliers = inliers_of(own, camera)
        if inliers is None:
            continue
        poses = [state.pose_at(frame.place, camera) or estimate for frame in own]
        block, runs = inliers.with_scale(state.cameras[camera].scale), to_runs(inliers.frame_edges)
        here = block.run_sums(np.array([*map(to_T_camera_lidar, poses)]), runs)
        for row, (frame, pose) in enumerate(zip(own, poses, strict=True)):
            step = step_between(pose, reference)
            frame.sums.gradient[camera] = here.gradient[row] + frame.sums.hessian[camera] @ step
            frame.sums.reweighted[camera] = here.hessian[row]
    return frames


def _ungated(state: State, epoch: Epoch, camera: int) -> Sums:
    """All matches of a camera in an epoch, whatever the gate."""
    raw = merge([frame.raw[camera] for frame in epoch.frames if camera in frame.raw])
    scale, pose = state.cameras[camera].scale, epoch.T_lidar_camera[camera]
    return sums_of_matches(raw, scale, pose, state.references[camera])


def _with_places(state: State, epoch: Epoch, drifted: Sequence[bool]) -> State:
    """The state with an epoch's sums added to those of its places.

    Of a camera that drifts there are only the sums that are discounted by its walk. When the drift
    has ended, what these hold counts as of one place.

    Args:
        state: with the epoch summarized.
        epoch: the epoch.
        drifted: per camera, whether it drifted before the epoch was summarized.
    """
    parts = sums_by_place(_at_places(state, epoch))
    places = state.places.add(parts).bounded()
    for camera, (one, before) in enumerate(zip(state.cameras, drifted, strict=True)):
        if one.summary.walk:
            places = places.without(camera)
        elif before and parts:
            places = places.with_camera_at([*parts][-1], camera, one.summary.selected)
    return changed(state, places=places)


def _update_evidence(state: State, camera: int, epoch: Epoch, by_places: Array) -> CameraState:
    """The camera with the evidence of its walks updated by how well they predict an epoch.

    The scatter of epochs is updated here too: by now, a move within the epoch has been detected.
    """
    one, alone = state.cameras[camera], state.scatter_of_frames(camera)
    sums = epoch.sums[camera]
    noise = state.frame_noise(camera)
    if noise is None or alone is None or not sums.frames:
        return one
    groups = tuple(group.add(sums.score, int(sums.frames), alone) for group in one.groups)
    rows = pose_rows(camera)
    noise = noise * sums.frames + sums.hessian @ by_places[rows, rows] @ sums.hessian
    return changed(one, summary=one.summary.update_evidence(sums, noise), groups=groups)


def _select_walks(state: State) -> State:
    """The state with each camera's walk selected by the evidence."""
    for camera, camera_state in enumerate(state.cameras):
        summary = camera_state.summary.select_walk()
        if summary.walk > 0 == camera_state.summary.walk:
            state = follow_drift(state, camera, summary.walk)
        else:
            state = state.with_camera(camera, changed(camera_state, summary=summary))
    return state
