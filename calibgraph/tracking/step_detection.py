"""Finding that something moved in what the frames say, and going on from there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, merge
from calibgraph.tracking.drift import drifting
from calibgraph.tracking.epoch_summary import Memory, step_between
from calibgraph.tracking.events import (
    Cause,
    Event,
    Size,
    Steps,
    alarm_limit,
    cause_of,
    squared_sigmas,
)
from calibgraph.tracking.outlier_frames import agrees, refined
from calibgraph.tracking.posterior import (
    Posterior,
    inverse,
    posterior,
    quadratic,
)
from calibgraph.tracking.start import absorbed_late
from calibgraph.tracking.state import (
    CameraState,
    DriftWatch,
    LiveFrame,
    State,
    Suspect,
    block_diagonal,
    put,
)

Array = NDArray[np.float64]

_PATIENCE = 5  # frames more, for the other cameras to say whether they moved too
_OUTVOTE = 2  # suspects per frame that still agrees with the old pose
_RECENTLY = 300  # frames: a second small move within them is a drift
_GUESSED_OVERCONFIDENCE = 100.0  # of H, while the frames' scatter is not known
_OLD_SHARE = 0.25  # of the live epochs: a change before their end came slowly
_FOLLOWING = 2  # the walk by which a change is followed, at least: the configured one
_LEAST_EPOCHS = 1.0  # remembered, before which nothing is known of how epochs scatter
_BEFORE = 20.0  # frames that must stand against a small move


@dataclass(frozen=True, eq=False)
class Found:
    """A step of some cameras.

    Attributes:
        since: number of the first frame after it.
        sure: the cameras that it was found by.
        suspects: per camera, the frames set aside that agree on its new place.
    """

    since: int
    sure: frozenset[int]
    suspects: Mapping[int, tuple[Suspect, ...]] = field(default_factory=dict)


def found_step(state: State) -> Found | None:
    """A step so large that frames after it do not agree with the estimate.

    It is believed when enough suspects agree with each other, and all other cameras have had
    their say.
    """
    needed = state.config.tracking.step_frames
    clusters = {c: _cluster(known) for c, known in enumerate(state.cameras)}
    sure = {
        c: near
        for c, near in clusters.items()
        if len(near) >= needed and len(near) >= _OUTVOTE * _agreed(state.cameras[c], near[0].number)
    }
    if not sure:
        return None
    since = min(near[0].number for near in sure.values())
    longest = max(len(near) for near in sure.values())
    waiting = any(
        _agreed(known, since) + sum(1 for s in clusters[c] if s.number >= since) < needed
        for c, known in enumerate(state.cameras)
        if known.started and known.absent < state.config.tracking.blind_frames
    )
    if waiting and longest < needed + _PATIENCE:
        return None
    return Found(since, frozenset(sure), clusters)


def _cluster(known: CameraState) -> tuple[Suspect, ...]:
    """The suspects that agree with the newest one; a single one may be anything."""
    if not known.suspects:
        return ()
    newest = known.suspects[-1]
    near = tuple(s for s in known.suspects if agrees(s.raw, newest.pose, known))
    return near if len(near) > 1 else ()


def _agreed(known: CameraState, since: int) -> int:
    """How many frames since a number agree with the estimate."""
    return sum(1 for number, good in known.verdicts if good and number >= since)


def _is_pending(known: CameraState) -> bool:
    """Whether the last frame was a suspect, which others may follow."""
    last = known.verdicts[-1] if known.verdicts else None
    return bool(last and not last[1] and known.suspects and known.suspects[-1].number == last[0])


def found_shift(state: State) -> Found | None:
    """A step so small that frames after it still agree with the estimate, at an epoch's start.

    Not while suspects may show that it is a large one.
    """
    best, found = 0.0, None
    if any(_is_pending(known) for known in state.cameras):
        return None
    for epoch in state.epochs[1:]:
        if not epoch.frames:
            continue
        since = epoch.frames[0].number
        before, after = posterior(state, since), _absorbed_since(state, since)
        for camera, known in enumerate(state.cameras):
            excess = _shift_excess(state, camera, before, after)
            if known.started and excess > best:
                best, found = excess, Found(since, frozenset([camera]))
    return found


def _shift_excess(state: State, camera: int, before: Posterior, after: Posterior) -> float:
    """By how much a camera's frames after a time contradict those before, over the limit.

    A score test: what the frames do not determine does not count.
    """
    step, frames = before.step(camera), before.frames[camera]
    known_scatter = state.cameras[camera].groups[0].count >= _LEAST_EPOCHS
    if step is None or frames < _BEFORE or not known_scatter or not after.frames[camera]:
        return 0.0
    hessian = after.hessian[camera]
    rows = slice(6 * camera, 6 * camera + 6)
    inverse = np.linalg.inv(before.hessian[camera])
    uncertain = hessian @ inverse
    scatter = before.scatter[rows, rows]
    covariance = (
        scatter * (after.frames[camera] / (frames - 1)) + uncertain @ scatter @ uncertain.T
    ) * state.inflation(camera)
    score = after.gradient[camera] + hessian @ step
    return squared_sigmas(score, covariance) / alarm_limit(frames) - 1.0


def _absorbed_since(state: State, since: int) -> Posterior:
    """The sums over the absorbed frames since a number, as linearized at the estimate."""
    n = len(state.cameras)
    nothing = Posterior(
        np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros((6 * n, 6 * n)), np.zeros(n)
    )
    frames = [frame for frame in state.live_frames if frame.number >= since]
    return nothing.plus(frames, np.zeros((n, 6)))


def _parts(state: State, found: Found, camera: int) -> list[CameraBlock]:
    """A camera's matches in the frames since a step, those set aside too."""
    live = state.live_frames
    parts = [f.raw[camera] for f in live if f.number >= found.since and camera in f.raw]
    return parts + [s.raw for s in found.suspects.get(camera, ()) if s.number >= found.since]


def _after(state: State, found: Found) -> Posterior:
    """The sums over the frames since a step, linearized at the pose that they say themselves."""
    n = len(state.cameras)
    hessian, gradient, frames = np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros(n)
    for camera, known in enumerate(state.cameras):
        parts = _parts(state, found, camera)
        if not known.started or not parts:
            continue
        near = found.suspects.get(camera, ())
        start = near[-1].pose if near else state.poses[camera]
        raw = merge(parts)
        pose = refined(raw, start, known.scale, state.config)
        used = raw.without_outliers(to_T_camera_lidar(pose), known.scale)
        if len(used.frame) >= MIN_MATCHES:
            reference = state.references[camera]
            hessian[camera], gradient[camera] = quadratic(raw, used, known.scale, pose, reference)
            frames[camera] = len(parts)
    return Posterior(hessian, gradient, np.zeros((6 * n, 6 * n)), frames)


def _steps(state: State, found: Found) -> tuple[Steps, dict[int, Array]]:
    """How far each camera seems to have stepped; and where it is now, from its reference."""
    before, after = posterior(state, found.since), _after(state, found)
    cameras, steps, now = [], [], {}
    for camera, known in enumerate(state.cameras):
        one, two = before.step(camera), after.step(camera)
        if known.started and one is not None and two is not None:
            cameras.append(camera)
            steps.append(two - one)
            now[camera] = two
    covariance = _covariance(state, before, after, cameras)
    limits = np.array([alarm_limit(state.total_frames[c]) for c in cameras])
    poses = tuple(state.references[c] for c in cameras)
    return Steps(tuple(cameras), np.ravel(steps), covariance, limits, poses), now


def _covariance(state: State, before: Posterior, after: Posterior, cameras: list[int]) -> Array:
    """(6 m, 6 m) of the difference of what is known before and after."""
    rows = np.concatenate([6 * c + np.arange(6) for c in cameras] or [np.empty(0, np.intp)])
    one, two = (block_diagonal(inverse(sums.hessian[cameras])) for sums in (before, after))
    noise = state.total.copy()
    for camera in cameras:
        own = slice(6 * camera, 6 * camera + 6)
        if state.frame_noise(camera) is None:
            noise[own], noise[:, own] = 0.0, 0.0
            noise[own, own] = after.hessian[camera] * _GUESSED_OVERCONFIDENCE
        else:
            noise[own] *= np.sqrt(after.frames[camera] / state.total_frames[camera])
            noise[:, own] *= np.sqrt(after.frames[camera] / state.total_frames[camera])
    scatter, spread = (sums[np.ix_(rows, rows)] for sums in (before.scatter, noise))
    inflation = np.repeat([np.sqrt(state.inflation(camera)) for camera in cameras], 6)
    covariance = one @ scatter @ one + two @ spread @ two
    return np.asarray(covariance * np.outer(inflation, inflation))


def shifted(state: State, found: Found) -> tuple[State, tuple[Event, ...]]:
    """The state after a small step; or with a drift followed, if it was none.

    A change that lies as far back as the live epochs go, or comes soon after another one, came
    slowly: it would have been found earlier, or at once.
    """
    (camera,) = found.sure
    known = state.cameras[camera]
    recently = known.moved_at >= 0 and state.updates - known.moved_at < _RECENTLY
    old = state.epochs[int(_OLD_SHARE * (len(state.epochs) - 1))]
    if found.since > old.frames[0].number and not recently:
        return moved(state, found)
    return drifting(state, camera, max(known.memory.best_walk, _FOLLOWING)), ()


def moved(state: State, found: Found) -> tuple[State, tuple[Event, ...]]:
    """The state after a step: what moved is told, and its cameras begin anew where they are."""
    found = _dated(state, found)
    steps, now = _steps(state, found)
    cause = cause_of(steps, found.sure)
    events = _events(state, found.since, steps, cause)
    targets = {camera: state.references[camera].retract(now[camera]) for camera in cause.cameras}
    if cause.lidar:
        by = gtsam.Pose3.Expmap(cause.lidar[0])
        others = set(range(len(state.cameras))) - set(targets)
        targets |= {camera: by.compose(state.poses[camera]) for camera in others}
    for camera in found.sure - set(steps.cameras):  # nothing to compare with
        if near := found.suspects.get(camera):
            targets[camera] = near[-1].pose
    for camera, pose in targets.items():
        state = _begun_anew(state, camera, pose, _parts(state, found, camera))
    if not cause.lidar:
        state = _without_pairs_of(state, targets)
    return state, events


def _dated(state: State, found: Found) -> Found:
    """The step with its first frame found: the one from which the new pose fits better."""
    steps, now = _steps(state, found)
    sure = [camera for camera in found.sure if camera in steps.cameras]
    if not sure:
        return found
    poses = {
        camera: (state.references[camera].retract(now[camera] - steps.of(place)[0]),
                 state.references[camera].retract(now[camera]))
        for place, camera in enumerate(steps.cameras) if camera in sure
    }  # fmt: skip
    frames = state.live_frames
    place = next((i for i, f in enumerate(frames) if f.number >= found.since), len(frames))
    while place > 0 and _fits_better(state, found, frames[place - 1], poses):
        place -= 1
    while place < len(frames) - 1 and _fits_better(state, found, frames[place], poses) is False:
        place += 1
    dated = replace(found, since=frames[min(place, len(frames) - 1)].number)
    told, _ = _steps(state, dated)
    return dated if set(sure) <= set(told.cameras) else found


def _fits_better(
    state: State,
    found: Found,
    frame: LiveFrame,
    poses: dict[int, tuple[gtsam.Pose3, gtsam.Pose3]],
) -> bool | None:
    """Whether a frame fits the second poses better than the first; None if it cannot tell."""
    suspects = {
        c: s.raw for c in poses for s in found.suspects.get(c, ()) if s.number == frame.number
    }
    seen = {c: m for c, m in {**frame.raw, **suspects}.items() if c in poses}
    if not seen:
        return None
    gain = 0.0
    for camera, raw in seen.items():
        block = raw.with_scale(state.cameras[camera].scale)
        before, after = (float(block.sums(pose).cost) for pose in poses[camera])
        gain += before - after
    return gain > 0


def _events(state: State, since: int, steps: Steps, cause: Cause) -> tuple[Event, ...]:
    def event(camera: str | None, size: Size) -> Event:
        return Event("moved", camera, since, state.frame or 0, state.stamp_ns, size)

    if cause.lidar:
        return (event(None, Size.of(*cause.lidar)),)
    return tuple(
        event(state.names[camera], Size.of(*steps.of(steps.cameras.index(camera))))
        for camera in cause.cameras
    )


def _begun_anew(state: State, camera: int, pose: gtsam.Pose3, parts: list[CameraBlock]) -> State:
    """The state with all forgotten of a camera but the frames since it moved, at a pose."""
    known = state.cameras[camera]
    set_aside = {suspect.number for suspect in known.suspects}
    epochs = tuple(
        replace(epoch, frames=tuple(frame.without(camera) for frame in epoch.frames))
        for epoch in state.epochs
    )
    cross = state.cross.copy()
    rows = slice(6 * camera, 6 * camera + 6)
    cross[rows], cross[:, rows] = 0.0, 0.0
    known = known.counted(left_out=-sum(1 for part in parts if part.frame[0] in set_aside))
    known = replace(
        known, memory=Memory.empty(), suspects=(), verdicts=(), moved_at=state.updates, absent=0
    )
    drift = None if state.drift is not None and state.drift.camera == camera else state.drift
    state = replace(
        state,
        epochs=epochs,
        cross=cross,
        references=put(state.references, camera, pose),
        drift=_seen_from(drift, camera, step_between(state.references[camera], pose)),
    ).with_camera(camera, known)
    return absorbed_late(state, camera, parts, pose)


def _seen_from(drift: DriftWatch | None, camera: int, step: Array) -> DriftWatch | None:
    """The watch of a drift, of which one camera stepped aside: its anchor is where it now is."""
    if drift is None:
        return None
    anchor = drift.anchors[camera].seen_from(step)
    return replace(drift, anchors=put(drift.anchors, camera, anchor))


def _without_pairs_of(state: State, cameras: Iterable[int]) -> State:
    """A camera that moved alone is no longer where the rig's relative poses say."""
    wrong = [
        place
        for place, pair in enumerate(state.rig.relative_poses)
        if any(state.names[c] in (pair.a, pair.b) for c in cameras)
    ]
    return replace(state, dropped_pairs=tuple(sorted({*state.dropped_pairs, *wrong})))
