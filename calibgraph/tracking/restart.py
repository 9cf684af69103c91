"""After a step: what moved is reported, and its cameras restart from the frames since."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.solver.matches import CameraBlock, merge
from calibgraph.tracking.cause import Cause, Steps, find_cause
from calibgraph.tracking.drift import follow_drift
from calibgraph.tracking.epoch_summary import EpochSummary
from calibgraph.tracking.epoch_sums import sum_epochs
from calibgraph.tracking.events import Event, Size
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.gated import Gated
from calibgraph.tracking.live_frames import NO_DISTORTION, LiveFrame
from calibgraph.tracking.outlier_frames import refine
from calibgraph.tracking.start import absorb_frames
from calibgraph.tracking.state import DriftWatch, State, replace_item
from calibgraph.tracking.step_detection import DetectedStep
from calibgraph.tracking.steps import shift_since, steps_between
from calibgraph.tracking.sums import Sums, step_between

Measured = tuple[Steps, dict[int, Array]]

_RECENTLY = 300  # frames: a second small step within them is a drift
_GUESSED_OVERCONFIDENCE = 100.0  # of H, while the frames' scatter is not known
_OLD_SHARE = 0.25  # of the live epochs: a change before their end came slowly
_FOLLOWING = 2  # the least walk by which a change is followed: the configured one


def handle_small_step(state: State, detected: DetectedStep) -> tuple[State, tuple[Event, ...]]:
    """The state after a small step; or with a drift followed, if it was slow.

    A change that lies as far back as the live epochs go, or comes soon after another one, came
    slowly: a step would have been detected earlier, or at once.
    """
    (camera,) = detected.found_by
    camera_state = state.cameras[camera]
    recently = camera_state.moved_at >= 0 and state.updates - camera_state.moved_at < _RECENTLY
    old = state.epochs[int(_OLD_SHARE * (len(state.epochs) - 1))]
    if detected.since > old.frames[0].number and not recently:
        return restart_after_step(state, detected)
    return follow_drift(state, camera, max(camera_state.summary.best_walk, _FOLLOWING)), ()


def restart_after_step(state: State, detected: DetectedStep) -> tuple[State, tuple[Event, ...]]:
    """The state after a step, with the moved cameras restarted, and the events."""
    detected, (steps, now) = _date_step(state, detected)
    cause = find_cause(steps, detected.found_by)
    events = _make_events(state, detected.since, steps, cause)
    targets = {camera: state.references[camera].retract(now[camera]) for camera in cause.cameras}
    if cause.lidar:
        by = gtsam.Pose3.Expmap(cause.lidar[0])
        others = set(range(len(state.cameras))) - set(targets)
        targets |= {camera: by.compose(state.T_lidar_camera[camera]) for camera in others}
    for camera in detected.found_by - set(steps.cameras):  # nothing to compare with
        if near := detected.outlier_frames.get(camera):
            targets[camera] = near[-1].T_lidar_camera
    for camera, T_lidar_camera in targets.items():
        state = _restart_camera(
            state, camera, T_lidar_camera, _blocks_since(state, detected, camera)
        )
    if not cause.lidar:
        state = _drop_pairs_of(state, targets)
    return state.with_moves(events), events


def _date_step(state: State, detected: DetectedStep) -> tuple[DetectedStep, Measured]:
    """The step with its first frame: the one from which the new estimates fit better.

    With it, what :func:`_measure_steps` gives for it.
    """
    measured = steps, now = _measure_steps(state, detected)
    found_by = [camera for camera in detected.found_by if camera in steps.cameras]
    if not found_by:
        return detected, measured
    before_and_after = {
        camera: (state.references[camera].retract(now[camera] - steps.of(place)[0]),
                 state.references[camera].retract(now[camera]))
        for place, camera in enumerate(steps.cameras) if camera in found_by
    }  # fmt: skip
    frames = state.live_frames
    place = next((i for i, f in enumerate(frames) if f.number >= detected.since), len(frames))
    while place > 0 and _fits_better(state, detected, frames[place - 1], before_and_after):
        place -= 1
    while (
        place < len(frames) - 1
        and _fits_better(state, detected, frames[place], before_and_after) is False
    ):
        place += 1
    since = frames[min(place, len(frames) - 1)].number
    if since == detected.since:
        return detected, measured
    dated = changed(detected, since=since)
    remeasured = _measure_steps(state, dated)
    if set(found_by) <= set(remeasured[0].cameras):
        return dated, remeasured
    return detected, measured


def _fits_better(
    state: State,
    detected: DetectedStep,
    frame: LiveFrame,
    before_and_after: dict[int, tuple[gtsam.Pose3, gtsam.Pose3]],
) -> bool | None:
    """Whether a frame fits the second estimates better than the first; None without matches."""
    outlier_frames = {
        c: s.raw
        for c in before_and_after
        for s in detected.outlier_frames.get(c, ())
        if s.number == frame.number
    }
    seen = {
        c: block for c, block in {**frame.raw, **outlier_frames}.items() if c in before_and_after
    }
    if not seen:
        return None
    gain = 0.0
    for camera, raw in seen.items():
        block = raw.with_scale(state.cameras[camera].scale)
        before, after = (float(block.sums(T).cost) for T in before_and_after[camera])
        gain += before - after
    return gain > 0


def _make_events(state: State, since: int, steps: Steps, cause: Cause) -> tuple[Event, ...]:
    def event(camera: str | None, size: Size) -> Event:
        return Event("moved", camera, since, state.frame or 0, state.stamp_ns, size)

    if cause.lidar:
        return (event(None, Size.of(*cause.lidar)),)
    return tuple(
        event(state.names[camera], Size.of(*steps.of(steps.cameras.index(camera))))
        for camera in cause.cameras
    )


def _restart_camera(
    state: State, camera: int, T_lidar_camera: gtsam.Pose3, parts: list[CameraBlock]
) -> State:
    """The state with a camera restarted at T_lidar_camera from the frames since it moved."""
    camera_state = state.cameras[camera]
    set_aside = {frame.number for frame in camera_state.outlier_frames}
    epochs = tuple(
        changed(epoch, frames=tuple(frame.without(camera) for frame in epoch.frames))
        for epoch in state.epochs
    )
    camera_state = camera_state.count(
        left_out=-sum(1 for part in parts if part.frame[0] in set_aside)
    )
    camera_state = changed(
        camera_state,
        summary=EpochSummary.empty(),
        outlier_frames=(),
        agreements=(),
        moved_at=state.updates,
        absent=0,
    )
    drift = None if state.drift is not None and state.drift.camera == camera else state.drift
    at_new_pose = changed(  # its matches follow the distortion in another way now
        state.distortion[camera], jacobian=NO_DISTORTION.jacobian, hessian=NO_DISTORTION.hessian
    )
    state = changed(
        state,
        epochs=epochs,
        places=state.places.without(camera),
        distortion=replace_item(state.distortion, camera, at_new_pose),
        references=replace_item(state.references, camera, T_lidar_camera),
        drift=_with_anchor_at(
            drift, camera, step_between(state.references[camera], T_lidar_camera)
        ),
    ).with_camera(camera, camera_state)
    return absorb_frames(state, camera, parts, T_lidar_camera)


def _with_anchor_at(drift: DriftWatch | None, camera: int, step: Array) -> DriftWatch | None:
    """The watch with one camera's anchor moved by the step of that camera."""
    if drift is None:
        return None
    own = drift.anchors[camera].shift_reference(step)
    return changed(drift, anchors=drift.anchors.replace_at(camera, own))


def _drop_pairs_of(state: State, cameras: Iterable[int]) -> State:
    """The state without the relative poses of cameras that moved alone."""
    wrong = [
        place
        for place, pair in enumerate(state.rig.relative_poses)
        if any(state.names[c] in (pair.a, pair.b) for c in cameras)
    ]
    return changed(state, dropped_pairs=tuple(sorted({*state.dropped_pairs, *wrong})))


def _blocks_since(state: State, detected: DetectedStep, camera: int) -> list[CameraBlock]:
    """A camera's matches in the frames since a step, including those set aside."""
    live = state.live_frames
    parts = [f.raw[camera] for f in live if f.number >= detected.since and camera in f.raw]
    return parts + [
        s.raw for s in detected.outlier_frames.get(camera, ()) if s.number >= detected.since
    ]


def _sums_since(state: State, detected: DetectedStep) -> Sums:
    """The sums over the frames since a step, linearized at the estimate that fits them."""
    found = Sums.zeros(len(state.cameras))
    for camera, camera_state in enumerate(state.cameras):
        parts = _blocks_since(state, detected, camera)
        if not camera_state.started or not parts:
            continue
        near = detected.outlier_frames.get(camera, ())
        start = near[-1].T_lidar_camera if near else state.T_lidar_camera[camera]
        raw = merge(parts)
        T_lidar_camera = refine(raw, start, camera_state.scale, state.config)
        scale, reference = camera_state.scale, state.references[camera]
        together = np.array([0, len(raw)])
        own = Gated.at(T_lidar_camera, raw, scale, reference, edges=together).sums[0]
        if own.matches:
            found = found.replace_at(camera, own.change(frames=np.array(float(len(parts)))))
    return found


def _measure_steps(state: State, detected: DetectedStep) -> Measured:
    """The steps of the cameras; and per camera its estimate now, from its reference."""
    before, after = sum_epochs(state, detected.since), _sums_since(state, detected)
    new = [c for c in range(len(state.cameras)) if state.frame_noise(c) is None]
    guessed = {camera: after.hessian[camera] * _GUESSED_OVERCONFIDENCE for camera in new}
    own = {camera: before.scatter[camera] for camera in (*new, *state.drifting)}
    by_places = shift_since(state, detected.since)
    return steps_between(state, (before, own), (after, guessed), by_places)
