"""The frames that are kept, gated and linearized anew at the end of an epoch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, merge
from calibgraph.solver.curvature import convex_hessian, robust_hessian
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import step_between

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

    That of the matches within a gate is drawn to where the gate was before. A camera that drifts
    keeps its estimate, which later epochs have a part in.
    """
    one, reference = state.cameras[camera], state.references[camera]
    if one.summary.walk:
        return T_lidar_camera
    block, older = raw.with_scale(one.scale), one.summary.ungated
    for _ in range(_GATE_STEPS):
        sums, step = block.sums(T_lidar_camera), step_between(reference, T_lidar_camera)
        pull = sums.gradient + older.gradient + older.hessian @ step
        whole = sums.hessian + older.hessian + WEAK
        T_lidar_camera = T_lidar_camera.retract(-np.linalg.solve(whole, pull))
    return T_lidar_camera
