"""Bookkeeping of a frame in the state: absorbed, left out, or without usable matches."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from calibgraph.graph.variables import cloud_at_key, matched_at_key
from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.elimination import Linearization
from calibgraph.solver.matches import (
    CameraBlock,
    camera_blocks,
)
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.assessment import rig_at
from calibgraph.tracking.cause import chance_limit
from calibgraph.tracking.closed_places import ClosedPlaces
from calibgraph.tracking.events import Event
from calibgraph.tracking.frame_order import PLACE, Incoming
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.gated import Gated
from calibgraph.tracking.live_frames import LiveFrame, OutlierFrame
from calibgraph.tracking.outlier_frames import agrees, find_outlier_frame
from calibgraph.tracking.place_model import states_places
from calibgraph.tracking.start import count_residuals
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, minimum, sums_of_matches

_LAST_FRAMES = 20  # of which it is kept whether they agree with the estimate
_UNUSUAL = 25.0  # squared sigmas of a six-vector
_TOTAL_KEPT = 1 - 1 / 2000  # of the total scatter, from frame to frame


def with_open_frames(state: State, *frames: LiveFrame) -> State:
    """The state with frames in its open epoch, in the place of those of the same numbers."""
    last, numbers = state.epochs[-1], {frame.number for frame in frames}
    others = (f for f in last.frames if f.number not in numbers)
    return changed(state, epochs=(*state.epochs[:-1], changed(last, frames=(*others, *frames))))


def begin_frames(state: State, frames: Sequence[Incoming]) -> State:
    """The state with frames begun, none of whose matches is absorbed."""
    last, count = frames[-1], len(state.names)
    found = [one.table.findings for one in frames if len(one.table)]
    state = changed(
        state,
        frame=last.number,
        stamp_ns=last.stamp_ns,
        updates=state.updates + len(frames),
        findings=found[-1] if found else state.findings,
    )
    empty = (LiveFrame.empty(f.number, count, f.table.metadata.get(PLACE, "")) for f in frames)
    return with_open_frames(state, *empty)


def blocks_by_camera(state: State, table: Correspondences) -> dict[int, CameraBlock]:
    """The preprocessed matches of each camera that has enough.

    Args:
        state: before the frame.
        table: of the frame.
    """
    if not len(table):
        return {}
    kept = preprocess(rig_at(state, state.T_lidar_camera), table, state.config)
    blocks = camera_blocks(state.rig, kept.table, state.config)
    return {state.names.index(name): block for name, block in blocks.items()}


def at_minimum(state: State, closed: ClosedPlaces, more: Mapping[int, Sums] | None = None) -> State:
    """The state with the last epoch's estimates at the minimum of Eq. 5, where frames are gated.

    Args:
        state: the tracker's.
        closed: its closed epochs.
        more: sums of further matches, per camera.
    """
    return state.at_poses(minimum(closed.equation_5(state, more), state.T_lidar_camera))


def select_agreeing(
    state: State, closed: ClosedPlaces, blocks: Mapping[int, CameraBlock]
) -> tuple[State, dict[int, CameraBlock]]:
    """The blocks of started cameras that agree with the estimate; the others are set aside.

    One that agrees with the pose of its place does, too.
    """
    agreeing = {}
    for camera, block in blocks.items():
        one, T_lidar_camera = state.cameras[camera], state.T_lidar_camera[camera]
        if not one.started:
            continue
        if agrees(block, T_lidar_camera, one):
            agreeing[camera] = block
            continue
        own = find_outlier_frame(
            state.frame or 0,
            block,
            T_lidar_camera,
            camera=state.rig.cameras[state.names[camera]],
            camera_state=one,
            config=state.config,
        )
        if own is not None and agrees_at_its_place(state, closed, camera, own):
            agreeing[camera] = block
        else:
            state = _set_aside(state, camera, own)
    return state, agreeing


def agrees_at_its_place(state: State, closed: ClosedPlaces, camera: int, own: OutlierFrame) -> bool:
    """Whether a frame that disagrees with a camera's estimate agrees with the pose of its place.

    In the graph with this frame: if its place is displaced by no more than places are, and the
    pose there explains it.

    Args:
        state: before the frame is absorbed; the last live frame has its place.
        closed: its closed epochs.
        camera: by its place in the rig.
        own: the frame, with the T_lidar_camera that fits it.
    """
    one, frame = state.cameras[camera], state.live_frames[-1]
    if one.summary.walk or not states_places(state):
        return False
    gated = Gated.at(own.T_lidar_camera, own.raw, one.scale, state.references[camera])
    if not gated.sums.matches[0]:
        return False
    state = with_open_frames(state, frame.add(camera, gated))
    window, _ = closed.with_open_epoch(state, None)
    place = window.places.index(frame.place)
    displaced = Linearization.at(window.model, window.values).distances[place, [0, 1 + camera]]
    if displaced @ displaced > chance_limit():
        return False
    cloud, pose = window.T_lidar_camera([cloud_at_key(place), matched_at_key(place, camera)])
    return agrees(own.raw, cloud.between(pose), one)


def _set_aside(state: State, camera: int, own: OutlierFrame | None) -> State:
    """The state with a camera's block counted as left out.

    It is kept as an outlier frame if another T_lidar_camera explains it; otherwise the matching has
    failed.
    """
    camera_state, number = state.cameras[camera], state.frame or 0
    kept = camera_state.outlier_frames
    camera_state = changed(
        camera_state,
        outlier_frames=kept if own is None else (*kept, own)[-_LAST_FRAMES:],
        agreements=(*camera_state.agreements, (number, False))[-_LAST_FRAMES:],
    )
    return state.with_camera(camera, camera_state.count(left_out=1, failed=1 if own is None else 0))


def absorb(
    state: State, closed: ClosedPlaces, blocks: Mapping[int, CameraBlock], frames: int = 1
) -> tuple[State, list[dict[int, int]]]:
    """The state with the inliers of its last frames, and how many each has, per camera.

    In two passes: the gate is drawn at the minimum with all matches of the blocks.
    """
    used = [dict[int, int]() for _ in range(frames)]
    if not blocks:
        return state, used
    everything = {
        camera: sums_of_matches(
            block,
            state.cameras[camera].scale,
            state.T_lidar_camera[camera],
            state.references[camera],
        )
        for camera, block in blocks.items()
    }
    state = at_minimum(state, closed, everything)
    newest = [*state.epochs[-1].frames[-frames:]]
    rows = {frame.number: row for row, frame in enumerate(newest)}
    for camera, block in blocks.items():
        gated = _gated(state, camera, block)
        if gated is None:
            continue
        raw, counts = gated.residuals.block, gated.sums.matches.astype(np.int64).tolist()
        for of_block, number in enumerate(raw.frame_numbers.tolist()):
            row = rows[number]
            newest[row] = newest[row].add(camera, gated, row=of_block)
            used[row][camera] = counts[of_block]
        state = _count_absorbed(state, camera, gated)
    state = add_to_totals(with_open_frames(state, *newest), newest)
    return at_minimum(state, closed), used


def _gated(state: State, camera: int, block: CameraBlock) -> Gated | None:
    """The frames of a block with enough matches within the gate; None if there are none."""
    scale, reference = state.cameras[camera].scale, state.references[camera]
    pose = state.T_lidar_camera[camera]
    gated = Gated.at(pose, block, scale, reference)
    enough = gated.sums.matches > 0
    if enough.all():
        return gated
    if not enough.any():
        return None
    kept = block.select(np.repeat(enough, block.frame_counts))
    return Gated.at(pose, kept, scale, reference)


def _count_absorbed(state: State, camera: int, gated: Gated) -> State:
    """The state with a camera's frames absorbed, and their residuals counted."""
    one, numbers = state.cameras[camera], gated.residuals.block.frame_numbers.tolist()
    one = count_residuals(one, gated.residuals, gated.inliers)
    agreements = (*one.agreements, *((number, True) for number in numbers))[-_LAST_FRAMES:]
    one = changed(one, agreements=agreements)
    given, used = len(gated.inliers), int(gated.sums.matches.sum())
    return state.with_camera(camera, one.count(absorbed=len(numbers), given=given, used=used))


def add_to_totals(state: State, frames: Sequence[LiveFrame]) -> State:
    """The state with frames added to the scatter of all frames, in their order.

    An unusual frame is down-weighted: it may come after a move that has not been detected yet.
    """
    sums, kept = Sums.stack([frame.sums for frame in frames]), _TOTAL_KEPT ** len(frames)
    scores = sums.score.copy()
    for camera in range(len(state.cameras)):
        noise, own = state.frame_noise(camera), scores[:, camera]
        if noise is not None:
            unusual = (own * np.linalg.solve(noise, own.T).T).sum(axis=1)
            own *= np.sqrt(_UNUSUAL / np.maximum(unusual, _UNUSUAL))[:, None]
    ages = _TOTAL_KEPT ** np.arange(len(frames) - 1.0, -1.0, -1.0)
    flat = scores.reshape(len(frames), -1)
    return changed(
        state,
        total=kept * state.total + (ages * flat.T) @ flat,
        total_hessian=kept * state.total_hessian + np.tensordot(ages, sums.hessian, axes=1),
        total_frames=kept * state.total_frames + ages @ sums.frames,
    )


def count_repeats(state: State, given: Correspondences, new: Correspondences) -> State:
    """The state with the frames in a row counted, per camera, that repeat the one before them.

    Args:
        state: of the tracker.
        given: the correspondences of a frame.
        new: those of cameras that do not repeat.
    """
    if given is new and not any(one.counts.get("repeated") for one in state.cameras):
        return state
    again = np.setdiff1d(given.camera_index, new.camera_index)
    for number in np.unique(given.camera_index).tolist():
        name = given.cameras[number]
        camera = state.names.index(name)
        counts = state.cameras[camera].counts
        before = counts.get("repeated", 0)
        repeated = before + 1 if number in again else 0
        if repeated != before:
            one = changed(state.cameras[camera], counts={**counts, "repeated": repeated})
            state = state.with_camera(camera, one)
    return state


def count_absent(state: State, used: Collection[int], frame: Incoming) -> tuple[State, list[Event]]:
    """The state with the frames without usable matches counted; events ``blind`` and ``back``.

    Args:
        state: after a frame, or more.
        used: the cameras whose matches of the frame were absorbed, by their places in the rig.
        frame: this one.
    """
    events = []
    limit, number, stamp_ns = state.config.tracking.blind_frames, frame.number, frame.stamp_ns
    for camera, camera_state in enumerate(state.cameras):
        if not camera_state.started:
            continue
        absent = 0 if camera in used else camera_state.absent + 1
        name = state.names[camera]
        if absent == limit:
            since = _number_of_frame_ago(state, limit, number)
            events.append(Event("blind", name, since, number, stamp_ns))
        if absent == 0 and camera_state.absent >= limit:
            events.append(Event("back", name, number, number, stamp_ns))
        if absent != camera_state.absent:
            state = state.with_camera(camera, changed(camera_state, absent=absent))
    return state, events


def _number_of_frame_ago(state: State, frames: int, last: int) -> int:
    """Number of the frame so many frames before and with the last; at least a live one."""
    numbers = [frame.number for frame in state.live_frames if frame.number <= last]
    return numbers[-min(frames, len(numbers))]
