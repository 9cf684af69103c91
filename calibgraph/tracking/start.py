"""A camera's first estimate: the batch solve of its first frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.rig import Rig
from calibgraph.pipeline import solve
from calibgraph.solver.matches import BlockResiduals, CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.events import Event
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.gated import Gated
from calibgraph.tracking.live_frames import Epoch
from calibgraph.tracking.noise import ResidualHistogram, median
from calibgraph.tracking.state import HISTORY, State, replace_item

_TRY_AGAIN = 1.5  # growth of the number of frames from attempt to attempt


def start_cameras(
    state: State, table: Correspondences, seen: Iterable[int]
) -> tuple[State, list[Event]]:
    """The state after one more frame of the cameras that have no estimate yet.

    Args:
        state: before.
        table: the correspondences of the frame.
        seen: the cameras that have enough of them.
    """
    events = []
    for camera in seen:
        if not state.cameras[camera].started:
            state = _try_to_start(state, camera, table)
            if state.cameras[camera].started:
                name, number = state.names[camera], state.frame or 0
                events.append(Event("started", name, number, number, state.stamp_ns))
    return state, events


def _try_to_start(state: State, camera: int, table: Correspondences) -> State:
    camera_state, name = state.cameras[camera], state.names[camera]
    waiting = (*camera_state.waiting, table.of_camera(name))[-HISTORY:]
    state = state.with_camera(camera, changed(camera_state, waiting=waiting))
    if not _is_attempt_due(len(camera_state.waiting) + 1, state.config.tracking.start_frames):
        return state
    rig = Rig(lidar=state.rig.lidar, cameras={name: state.rig.cameras[name]})
    try:
        result = solve(rig, concatenate(waiting), state.config)
    except CorrespondenceError as error:
        return _wait_longer(state, camera, (str(error),))
    if result.verdict.status == "FAIL":
        return _wait_longer(state, camera, result.camera_verdicts[name].reasons)
    T_lidar_camera = to_T_lidar_camera(result.T_camera_lidar[name])
    return _start_camera(state, camera, T_lidar_camera)


def _is_attempt_due(frames: int, first: int) -> bool:
    """At the first frames, then at growing intervals, then with every new window of frames."""
    attempts = first * _TRY_AGAIN ** np.arange(10)
    return frames in attempts.astype(int) or frames >= HISTORY


def _wait_longer(state: State, camera: int, reasons: tuple[str, ...]) -> State:
    camera_state = changed(state.cameras[camera], refused=reasons)
    if len(camera_state.waiting) >= HISTORY:  # tried with a full window: the older half makes room
        camera_state = changed(camera_state, waiting=camera_state.waiting[HISTORY // 2 :])
    return state.with_camera(camera, camera_state)


def _start_camera(state: State, camera: int, T_lidar_camera: gtsam.Pose3) -> State:
    """The state with a camera's first frames absorbed at its first estimate."""
    parts = [_camera_block(state, camera, table) for table in state.cameras[camera].waiting]
    usable = [part for part in parts if part is not None]
    residuals = [BlockResiduals.at(to_T_camera_lidar(T_lidar_camera), part) for part in usable]
    histogram = ResidualHistogram()
    for one in residuals:
        histogram = histogram.add(one)
    scale = histogram.scale(state.config)  # the gate by which inliers are counted below
    camera_state = changed(state.cameras[camera], started=True, waiting=(), refused=(), scale=scale)
    for one in residuals:
        camera_state = count_residuals(camera_state, one, one.inliers(scale))
    state = state.with_camera(camera, camera_state)
    state = changed(state, references=replace_item(state.references, camera, T_lidar_camera))
    return absorb_frames(state, camera, usable, T_lidar_camera)


def absorb_frames(
    state: State, camera: int, blocks: list[CameraBlock], T_lidar_camera: gtsam.Pose3
) -> State:
    """The state with a camera at a new estimate, and frames absorbed that had been set aside.

    Blocks of live frames are added to them; older ones are left out.
    """
    by_number = {int(part.frame[0]): part for part in blocks}
    scale, reference = state.cameras[camera].scale, state.references[camera]
    epochs: list[Epoch] = []
    counts: Counter[str] = Counter()
    for epoch in state.epochs:
        frames = []
        for before in epoch.frames:
            frame, raw = before, by_number.get(before.number)
            found = None if raw is None else Gated.at(T_lidar_camera, raw, scale, reference)
            if raw is not None and found is not None and found.sums.matches[0]:
                frame = frame.add(camera, found)
                used = int(found.sums.matches[0])
                counts.update(absorbed=1, given=len(raw.frame), used=used)
            frames.append(frame)
        epochs.append(
            changed(
                epoch,
                frames=tuple(frames),
                T_lidar_camera=replace_item(epoch.T_lidar_camera, camera, T_lidar_camera),
            )
        )
    if any(state.findings.bend_sigmas):
        epochs = [epoch.with_distortion(camera, scale) for epoch in epochs]
    state = changed(state, epochs=tuple(epochs), optimum=None)
    return state.with_camera(camera, state.cameras[camera].count(**counts))


def count_residuals(
    camera_state: CameraState, residuals: BlockResiduals, inliers: NDArray[np.bool_]
) -> CameraState:
    """The camera with the residuals of frames counted, and which of them are within the gate."""
    ends, errors_px = pairwise(residuals.block.frame_edges.tolist()), residuals.errors_px
    new = [
        (np.count_nonzero(inliers[first:end]) / (end - first), median(errors_px[first:end]))
        for first, end in ends
    ]
    recent = np.concatenate([camera_state.recent, new])[-HISTORY:]
    return changed(camera_state, recent=recent, residuals=camera_state.residuals.add(residuals))


def _camera_block(state: State, camera: int, table: Correspondences) -> CameraBlock | None:
    """The preprocessed matches of one camera's frame, None if there are too few."""
    name = state.names[camera]
    kept = preprocess(state.rig, table, state.config)
    return camera_blocks(state.rig, kept.table, state.config).get(name)
