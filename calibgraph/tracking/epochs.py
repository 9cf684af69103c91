"""The end of an epoch: the oldest live one is summarized, a new one begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import add

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import pose_rows, to_T_camera_lidar
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, merge
from calibgraph.solver.curvature import convex_hessian, robust_hessian
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.drift import follow_drift, report_drift
from calibgraph.tracking.epoch_summary import STRENGTHS
from calibgraph.tracking.events import Event
from calibgraph.tracking.live_frames import Epoch, LiveFrame, inliers_of
from calibgraph.tracking.offset_walk import add_epoch, bounded
from calibgraph.tracking.offsets import Offsets, delayed
from calibgraph.tracking.place_sums import sums_by_place
from calibgraph.tracking.state import State
from calibgraph.tracking.steps import shift_between
from calibgraph.tracking.sums import Sums, step_between, sums_of_matches
from factors import to_runs


def close_epoch(state: State, offsets: Offsets | None) -> tuple[State, list[Event]]:
    """The state with its open epoch closed and a new one begun.

    A camera that drifts keeps the estimate of each epoch; any other has the newest in all of them.

    Args:
        state: after the last frame of the epoch.
        offsets: the newest time offsets, if they are estimated.
    """
    epochs = tuple(_at_newest(state, epoch) for epoch in state.epochs)
    state = replace(state, epochs=epochs)
    if len(epochs) > state.config.tracking.live_epochs:
        state = _summarize_oldest(state)
    state = _with_references(state, state.T_lidar_camera, offsets)
    cameras = tuple(
        replace(one, scale=one.residuals.scale(state.config)) if one.started else one
        for one in state.cameras
    )
    state = replace(state, cameras=cameras)
    state = regate(state)
    epochs = state.epochs
    following = Epoch.empty(state.T_lidar_camera, state.width)
    epochs = (*epochs[:-1], _with_distortion(state, epochs[-1]), following)
    return report_drift(replace(state, epochs=epochs))


def _at_newest(state: State, epoch: Epoch) -> Epoch:
    estimates = zip(state.cameras, epoch.T_lidar_camera, state.T_lidar_camera, strict=True)
    poses = tuple(own if one.summary.walk else newest for one, own, newest in estimates)
    return replace(epoch, T_lidar_camera=poses)


def _with_distortion(state: State, epoch: Epoch) -> Epoch:
    """The epoch with the evidence of the scan distortion, if its size is stated."""
    if any(state.findings.bend_sigmas):
        for camera, one in enumerate(state.cameras):
            epoch = epoch.with_distortion(camera, one.scale)
    return epoch


def _with_references(
    state: State, references: tuple[gtsam.Pose3, ...], offsets: Offsets | None
) -> State:
    """The state with its sums about other references, but those of live frames."""
    steps = np.array([*map(step_between, state.references, references)])
    if offsets is not None and state.offsets is not None:
        offsets = replace(offsets, times=state.offsets.times)
        later_s = offsets.values_s - state.offsets.values_s
        steps = np.column_stack([steps, later_s])
        state = _with_points_at(replace(state, offsets=offsets), later_s)
    cameras = tuple(
        replace(camera_state, summary=camera_state.summary.shift_reference(step))
        for camera_state, step in zip(state.cameras, steps, strict=True)
    )
    drift = state.drift
    if drift is not None:
        drift = replace(drift, anchors=drift.anchors.shift_reference(steps))
    places = state.places.shift_reference(steps)
    return replace(state, cameras=cameras, references=references, places=places, drift=drift)


def at_offsets(state: State, offsets: Offsets) -> State:
    """The state with its matches at other time offsets, within an epoch."""
    return regate(_with_references(state, state.T_lidar_camera, offsets))


def _with_points_at(state: State, later_s: Array) -> State:
    """The state with the points of all kept matches some seconds later, (n,)."""
    epochs = tuple(
        replace(
            epoch,
            frames=tuple(
                replace(f, raw={c: delayed(raw, later_s[c]) for c, raw in f.raw.items()})
                for f in epoch.frames
            ),
        )
        for epoch in state.epochs
    )
    cameras = tuple(
        replace(
            one,
            outlier_frames=tuple(frame.delayed(seconds) for frame in one.outlier_frames),
        )
        for one, seconds in zip(state.cameras, later_s, strict=True)
    )
    return replace(state, epochs=epochs, cameras=cameras)


def _summarize_oldest(state: State) -> State:
    """The state with its oldest epoch added to the summaries."""
    epoch, *younger = state.epochs
    drifted = [one.summary.walk > 0 for one in state.cameras]
    by_places = shift_between(state, (), epoch.frames)
    cameras = range(len(state.cameras))
    evidence = tuple(_update_evidence(state, camera, epoch, by_places) for camera in cameras)
    state = _select_walks(replace(state, cameras=evidence))
    for camera, one in enumerate(state.cameras):
        summary = one.summary
        if epoch.sums.frames[camera]:
            summary = summary.add(epoch.sums[camera], _ungated(state, epoch, camera))
        variance = state.walk_variance(STRENGTHS, len(epoch.frames))
        summary = summary.propagate(variance, state.overconfidence(camera))
        state = state.with_camera(camera, replace(one, summary=summary))
    distortion = tuple(map(add, state.distortion, epoch.distortion))
    state = replace(state, epochs=tuple(younger), distortion=distortion)
    return _with_places(state, epoch, drifted)


def _at_places(state: State, epoch: Epoch) -> list[LiveFrame]:
    """The frames of an epoch, linearized at the poses of their places at the optimum."""
    frames = [replace(frame, sums=frame.sums.copy()) for frame in epoch.frames]
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
    parts, offsets = sums_by_place(_at_places(state, epoch)), state.offsets
    if offsets is None:
        places = state.places.add(parts).bounded()
    else:
        frames = len(epoch.frames)
        summed = add_epoch(state, state.places, offsets.times, parts=parts, frames=frames)
        places, times = bounded(state, *summed)
        offsets = replace(offsets, times=times)
    for camera, (one, before) in enumerate(zip(state.cameras, drifted, strict=True)):
        if one.summary.walk:
            places = places.without(camera)
        elif before and parts:
            places = places.with_camera_at([*parts][-1], camera, one.summary.selected)
    return replace(state, places=places, offsets=offsets)


def _update_evidence(state: State, camera: int, epoch: Epoch, by_places: Array) -> CameraState:
    """The camera with the evidence of its walks updated by how well they predict an epoch.

    The scatter of epochs is updated here too: by now, a move within the epoch has been detected.
    """
    one, alone = state.cameras[camera], state.scatter_of_frames(camera)
    score, sums = epoch.sums.pose.score[camera], state.of_pose(camera, epoch.sums[camera])
    noise = state.frame_noise(camera)
    if noise is None or alone is None or not sums.frames:
        return one
    alone = alone + state.score_by_offset(camera, epoch.sums[camera]) / sums.frames
    groups = tuple(group.add(score, int(sums.frames), alone) for group in one.groups)
    rows = pose_rows(camera)
    if state.offsets is not None:
        alone_7 = replace(epoch.sums[camera], scatter=np.zeros((7, 7)))
        noise = noise + state.of_pose(camera, alone_7).scatter / sums.frames
    noise = noise * sums.frames + sums.hessian @ by_places[rows, rows] @ sums.hessian
    walks = state.of_pose(camera, one.summary.walks)
    return replace(one, summary=one.summary.update_evidence(walks, sums, noise), groups=groups)


def _select_walks(state: State) -> State:
    """The state with each camera's walk selected by the evidence."""
    for camera, camera_state in enumerate(state.cameras):
        summary = camera_state.summary.select_walk()
        if summary.walk > 0 == camera_state.summary.walk:
            state = follow_drift(state, camera, summary.walk)
        else:
            state = state.with_camera(camera, replace(camera_state, summary=summary))
    return state


_GATE_STEPS = 3  # of Gauss-Newton: each leaves about a third of the way


def regate(state: State) -> State:
    """The state with its live frames gated, and linearized, at the newest estimates."""
    frames = {
        f.number: replace(f, inliers=dict(f.inliers), sums=f.sums.copy()) for f in state.live_frames
    }
    for camera, one in enumerate(state.cameras):
        epochs = state.epochs if one.summary.walk else state.epochs[-1:]
        for epoch in epochs:
            group = epoch.frames if one.summary.walk else state.live_frames
            own = [frames[f.number] for f in group if camera in f.raw]
            if own:
                _regate_camera(state, camera, own, epoch.T_lidar_camera[camera])
    epochs = tuple(
        replace(epoch, frames=tuple(frames[f.number] for f in epoch.frames))
        for epoch in state.epochs
    )
    return replace(state, epochs=epochs)


def _regate_camera(
    state: State, camera: int, frames: Sequence[LiveFrame], T_lidar_camera: gtsam.Pose3
) -> None:
    """Fill in a camera's inliers of frames, and their sums at an estimate.

    Hessians of frames are as they were, but for a share of what their sum is now.
    """
    scale, raw = state.cameras[camera].scale, merge([frame.raw[camera] for frame in frames])
    gate = _gate_pose(state, camera, raw, T_lidar_camera)
    rows = raw.within_gate(to_T_camera_lidar(gate), scale.gate_px)
    for frame, found in zip(frames, np.split(rows, raw.frame_edges[1:-1]), strict=True):
        if np.count_nonzero(found) >= MIN_MATCHES:
            frame.inliers[camera] = found
    inliers = raw.select(np.concatenate([frame.inliers[camera] for frame in frames]))
    block = inliers.with_scale(scale)
    here = block.frame_sums(T_lidar_camera, inliers.frame_edges)
    robust = robust_hessian(block, T_lidar_camera)
    true = convex_hessian(robust + raw.at(to_T_camera_lidar(gate)).gate_hessian(scale), robust)
    if state.offsets is not None:
        for frame in frames:
            frame.sums.hessian[camera] = 0.0
    missing = true - sum(frame.sums.hessian[camera] for frame in frames)
    shares = here.hessian @ np.linalg.solve(here.hessian.sum(axis=0) + WEAK, missing)
    step = step_between(T_lidar_camera, state.references[camera])
    for row, frame in enumerate(frames):
        sums, score = frame.sums, here.gradient[row]
        sums.hessian[camera] += (shares[row] + shares[row].T) / 2
        sums.gradient[camera] = score + sums.hessian[camera] @ step
        sums.reweighted[camera] = here.hessian[row]
        sums.score[camera], sums.scatter[camera] = score, np.outer(score, score)
        sums.matches[camera] = np.count_nonzero(frame.inliers[camera])


def _gate_pose(
    state: State, camera: int, raw: CameraBlock, T_lidar_camera: gtsam.Pose3
) -> gtsam.Pose3:
    """Where the gate is drawn: the minimum of all matches, as in a batch.

    That of the matches within a gate is drawn to where the gate was before. A camera that drifts,
    or whose time offset is estimated, keeps its estimate, which later epochs have a part in.
    """
    one, reference = state.cameras[camera], state.references[camera]
    if one.summary.walk or state.offsets is not None:
        return T_lidar_camera
    block, older = raw.with_scale(one.scale), one.summary.ungated
    for _ in range(_GATE_STEPS):
        sums, step = block.sums(T_lidar_camera), step_between(reference, T_lidar_camera)
        pull = sums.gradient + older.gradient + older.hessian @ step
        whole = sums.hessian + older.hessian + WEAK
        T_lidar_camera = T_lidar_camera.retract(-np.linalg.solve(whole, pull))
    return T_lidar_camera
