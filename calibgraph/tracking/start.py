"""A camera's first estimate: the batch solve of its first frames."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from calibgraph.errors import CorrespondenceError
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.rig import Rig
from calibgraph.pipeline import solve
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.posterior import quadratic
from calibgraph.tracking.spread import Spread
from calibgraph.tracking.state import HISTORY, CameraState, State, put

_TRY_AGAIN = 1.5  # so many times more frames than at the last attempt


def started(state: State, camera: int, table: Correspondences) -> State:
    """The state after a camera that has no estimate yet saw one more frame.

    Args:
        state: before.
        camera: its place in the rig.
        table: the correspondences of that frame.
    """
    known, name = state.cameras[camera], state.names[camera]
    own = table.of_camera(name)
    table = replace(own, cameras=(name,), camera_index=np.zeros_like(own.camera_index))
    waiting = (*known.waiting, table)[-HISTORY:]
    state = state.with_camera(camera, replace(known, waiting=waiting))
    if not _is_time(len(known.waiting) + 1, state.config.tracking.start_frames):
        return state
    rig = Rig(lidar=state.rig.lidar, cameras={name: state.rig.cameras[name]})
    try:
        result = solve(rig, concatenate(waiting), state.config)
    except CorrespondenceError as error:
        return _refused(state, camera, (str(error),))
    if result.verdict.status == "FAIL":
        return _refused(state, camera, result.camera_verdicts[name].reasons)
    pose = to_T_lidar_camera(result.T_camera_lidar[name])
    return _begun(state, camera, pose)


def _is_time(frames: int, first: int) -> bool:
    """At the first frames, then at growing intervals, then with every new window of frames."""
    attempts = first * _TRY_AGAIN ** np.arange(10)
    return frames in attempts.astype(int) or frames >= HISTORY


def _refused(state: State, camera: int, reasons: tuple[str, ...]) -> State:
    known = replace(state.cameras[camera], refused=reasons)
    if len(known.waiting) >= HISTORY:  # tried with a full window: the older half makes room
        known = replace(known, waiting=known.waiting[HISTORY // 2 :])
    return state.with_camera(camera, known)


def _begun(state: State, camera: int, pose: gtsam.Pose3) -> State:
    """The state with a camera's first frames absorbed at its first pose."""
    parts = [_matches(state, camera, table) for table in state.cameras[camera].waiting]
    usable = [part for part in parts if part is not None]
    spread = Spread()
    for part in usable:
        spread = spread.plus(part, to_T_camera_lidar(pose))
    scale = spread.scale(state.config)  # what `noted` counts inliers by
    known = replace(state.cameras[camera], started=True, waiting=(), refused=(), scale=scale)
    for part in usable:
        known = noted(known, part, pose)
    state = state.with_camera(camera, known)
    state = replace(state, references=put(state.references, camera, pose))
    return absorbed_late(state, camera, usable, pose)


def absorbed_late(
    state: State, camera: int, matches: list[CameraBlock], pose: gtsam.Pose3
) -> State:
    """The state with a camera at a pose, and frames of it that had been set aside.

    Those of live frames take their places in them; older ones are left out.
    """
    scale = state.cameras[camera].scale
    T = to_T_camera_lidar(pose)
    by_number = {int(part.frame[0]): part for part in matches}
    epochs, counts = [], {"absorbed": 0, "given": 0, "used": 0}
    for epoch in state.epochs:
        frames = []
        for frame in epoch.frames:
            raw = by_number.get(frame.number)
            used = None if raw is None else raw.without_outliers(T, scale)
            if raw is None or used is None or len(used.frame) < MIN_MATCHES:
                frames.append(frame)
                continue
            sums = quadratic(raw, used, scale, pose, state.references[camera])
            frames.append(frame.plus(camera, raw, used, sums))
            for key, more in (
                ("absorbed", 1),
                ("given", len(raw.frame)),
                ("used", len(used.frame)),
            ):
                counts[key] += more
        epochs.append(replace(epoch, frames=tuple(frames), poses=put(epoch.poses, camera, pose)))
    state = replace(state, epochs=tuple(epochs))
    return state.with_camera(camera, state.cameras[camera].counted(**counts))


def noted(known: CameraState, matches: CameraBlock, pose: gtsam.Pose3) -> CameraState:
    """The camera with a frame's residuals counted in what is usual."""
    T = to_T_camera_lidar(pose)
    errors, valid = matches.errors_px(T)
    share = float(np.mean(valid & (errors <= known.scale.gate_px)))
    recent = np.vstack([known.recent, [share, float(np.median(errors))]])[-HISTORY:]
    return replace(known, recent=recent, spread=known.spread.plus(matches, T))


def _matches(state: State, camera: int, table: Correspondences) -> CameraBlock | None:
    """The preprocessed matches of one camera's frame, None if there are too few."""
    name = state.names[camera]
    kept = preprocess(state.rig, table, state.config)
    return camera_blocks(state.rig, kept.table, state.config).get(name)
