"""Moves of cameras, or of the LiDAR under them: steps between frames, their detection, the restart.

Frames of one place share errors. So sums over frames before and after some time differ by more than
their scatter, unless they are of the same places: a change of place looks like a step of all
cameras, and is no move. Large steps are detected by frames that disagree, small ones by sums of
frames. What moved is reported, and its cameras restart from the frames since.

Slow drift is followed at once, and reported when clear. Of each camera's older epochs several sums
are kept side by side, each discounted by a random walk: static, and a few strengths of drift. Each
predicts every new epoch; the log-likelihoods of these predictions are its evidence, and the best
one is selected. Whether the camera that shows a drift first or the LiDAR drifts is decided later,
when the other cameras have shifted too, or have not. So the summaries of all cameras are kept as
anchors, and the steps from there are tested at every new epoch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import adjoints, invert, pose_rows, retract_all
from calibgraph.solver.components import pose_covariance
from calibgraph.solver.matches import MIN_MATCHES, CameraBlock, merge
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.absorption import absorb_again, sums_of
from calibgraph.tracking.cause import (
    CLEARLY,
    Steps,
    add_epoch,
    alarm_limit,
    find_cause,
    inflation,
    squared_sigmas,
    unexplained,
)
from calibgraph.tracking.events import Event, Kind, Size
from calibgraph.tracking.gate import Gated, refine
from calibgraph.tracking.state import STRENGTHS, DriftWatch, State, rows_of
from calibgraph.tracking.sums import Sums, block_diagonal, diagonal_blocks
from factors import to_runs
from factors.pose_kernel import logarithms

Scatters = Mapping[int, Array]
Measured = tuple[Steps, Array]


def steps_between(
    state: State,
    before: tuple[Sums, Scatters],
    after: tuple[Sums, Scatters],
    by_places: Array | None = None,
) -> Measured:
    """The steps of all cameras that are determined in both sets of frames.

    Args:
        state: of the tracker.
        before: (n,) sums over the first set; and per camera whose scatter is not as that of all
            frames, the (6, 6) scatter of its gradients.
        after: the same of the second set.
        by_places: (6 n, 6 n) covariance of the steps by what places share.

    Returns:
        The steps; (n, 6) from the reference of each such camera to where it is after.
    """
    one, two = before[0], after[0]
    cameras = np.flatnonzero(one.are_determined & two.are_determined).tolist()
    rows = rows_of(cameras)
    covariance = np.zeros((len(rows), len(rows)))
    ends = []
    for sums, own in (before, after):
        inverse = np.linalg.inv(sums.hessian[cameras])
        ends.append(-(inverse @ sums.gradient[cameras][..., None])[..., 0])
        flat = block_diagonal(np.asarray(inverse))
        covariance += flat @ _scatter(state, sums.frames, own)[np.ix_(rows, rows)] @ flat
    ratio = np.repeat(np.sqrt(inflation(state.groups[cameras])), 6)
    covariance *= np.outer(ratio, ratio)
    if by_places is not None:
        covariance += by_places[np.ix_(rows, rows)]
    limits, now = alarm_limit(state.total_frames[cameras]), np.zeros_like(one.gradient)
    apart, now[cameras] = np.ravel(ends[1] - ends[0]), ends[1]
    return Steps(tuple(cameras), apart, covariance, limits, state.references[cameras]), now


def _scatter(state: State, frames: Array, own: Scatters) -> Array:
    """(6 n, 6 n) scatter of the gradients of (n,) numbers of frames, as that of all frames is.

    Args:
        state: of the tracker.
        frames: of each camera.
        own: per camera for which that does not hold, its (6, 6) scatter.
    """
    share = np.repeat(np.sqrt(frames / np.maximum(state.total_frames, 1.0)), 6)
    found = state.total * np.outer(share, share)
    for camera, scatter in own.items():
        rows = pose_rows(camera)
        found[rows], found[:, rows] = 0.0, 0.0
        found[rows, rows] = scatter
    return found


def shift_between(state: State, row: int, end: int | None = None) -> Array:
    """(6 n, 6 n) covariance of the steps between sets of frames, by what places share.

    Errors that frames of the same place share cancel.

    Args:
        state: with the older frames, which are of the first set.
        row: of the first frame that is kept and not of the first set.
        end: of the first one that is of neither; None: all are of one.
    """
    n, findings = len(state.names), state.findings
    of_cloud = np.square([findings.place_rotation_rad, findings.place_translation_m])
    if not (findings.place_variance or of_cloud.any()):
        return np.zeros((6 * n, 6 * n))
    older = zip(state.places.names, state.places.frames, strict=True)
    counts = {name: np.stack([frames, np.zeros(n)]) for name, frames in older}
    for part, rows in enumerate((slice(row), slice(row, end))):
        for frames, name in zip(state.sums.frames[rows], state.at[rows], strict=True):
            counts.setdefault(name, np.zeros((2, n)))[part] += frames
    flat = adjoints(state.references).reshape(-1, 6)
    by_cloud = flat @ (state.ratios.cloud * pose_covariance(*of_cloud)) @ flat.T
    of_frame = state.total_hessian / np.maximum(state.total_frames, 1.0)[:, None, None]
    own = np.asarray(findings.place_variance * np.linalg.inv(of_frame + WEAK))
    before, after = np.stack([*counts.values()], axis=1)
    apart = before / np.maximum(before.sum(axis=0), 1.0)
    apart = apart - after / np.maximum(after.sum(axis=0), 1.0)
    both = apart.T @ apart
    of_cameras = block_diagonal(np.diag(both)[:, None, None] * own)
    return np.asarray(np.kron(both, np.ones((6, 6))) * by_cloud + of_cameras)


_QUIET = 1000  # frames in which a drift of the same camera is not reported again
_REPORT = 300  # frames until it is reported in any case

_EVIDENCE_KEPT = 0.98  # of the log-likelihood, from one epoch to the next: half in 34 epochs
_DISTANCE_CAP = 24.0  # squared sigmas of one epoch: so that a single outlier decides nothing
_SELECT = 12.0  # log-likelihood by which a walk must exceed the static model, or this one it
_PREFER_WALK = 3.0  # by which another strength must exceed the present one
_LEAST_FRAMES = 4.0  # for a prediction


def follow_drift(state: State, camera: int, walk: int) -> None:
    """Follow a camera by a random walk, and watch until it is clear what drifts."""
    reported_at = int(state.drift_reported_at[camera])
    quiet = reported_at >= 0 and state.updates - reported_at < _QUIET
    if state.drift is None and not quiet:
        oldest = int(state.numbers[0]) if len(state.numbers) else state.frame or 0
        since = max(0, oldest - int(state.walks.frames[camera, walk]))
        state.drift = DriftWatch(camera, state.updates, since, state.walks[:, 0])
    if not state.walk[camera]:
        state.put(camera, walk=walk, evidence=np.zeros_like(state.evidence[camera]))
        _restart_static(state, camera)


def report_drift(state: State) -> list[Event]:
    """The event of a drift, once it is clear what drifts."""
    watch = state.drift
    if watch is None:
        return []
    then, now = watch.anchors, state.all_sums()
    own, own_now = dict(enumerate(then.scatter)), dict(enumerate(now.scatter))
    steps, _ = steps_between(state, (then, own), (now, own_now))
    if watch.camera not in steps.cameras:
        state.drift = None
        return []
    by_lidar, by_camera = unexplained(steps)
    waited = state.updates - watch.begun
    if abs(by_lidar - by_camera) < CLEARLY and waited < _REPORT and len(steps.cameras) > 1:
        return []
    cause = find_cause(steps, found_by={watch.camera})
    camera = None if cause.lidar else watch.camera
    size = Size.of(*(cause.lidar or steps.of(watch.camera)))
    event = _event(state, "drifts", watch.frame, (camera, size))
    for drifting in range(len(state.names)) if camera is None else (camera,):
        state.put(drifting, drift_reported_at=state.updates)
    state.drift = None
    state.with_moves([event])
    return [event]


def _event(state: State, kind: Kind, since: int, found: tuple[int | None, Size]) -> Event:
    """Of a camera, or of the LiDAR."""
    name = None if found[0] is None else state.names[found[0]]
    return Event(kind, name, since, state.frame or 0, state.stamp_ns, found[1])


def update_evidence(state: State, epoch: Sums, by_places: Array) -> None:
    """Update the evidence of the cameras' walks by how well each predicts an (n,) epoch.

    The scatter of epochs is updated here too: by now, a move within the epoch has been detected.
    """
    cameras = np.flatnonzero((epoch.frames > 0) & state.is_known)
    own, noise, groups = epoch[cameras], state.frame_noise, state.groups.copy()
    alone = state.scatter_of_frames[cameras]
    groups[cameras] = add_epoch(groups[cameras], own.score, own.frames, alone)
    state.groups = groups
    cameras = cameras[(state.walks.frames[cameras] >= _LEAST_FRAMES).all(axis=1)]
    own = epoch[cameras]
    score, by_walk = _predict(state.walks[cameras], own[:, None])
    of_places = own.hessian @ diagonal_blocks(by_places)[cameras] @ own.hessian
    of_frames = noise[cameras] * own.frames[:, None, None] + of_places
    covariance = of_frames[:, None] + by_walk
    distance = (score * np.linalg.solve(covariance, score[..., None])[..., 0]).sum(axis=-1)
    logarithm = np.linalg.slogdet(covariance)[1]
    logarithm -= logarithm.min(axis=1, keepdims=True)
    gain = -0.5 * (np.minimum(distance, _DISTANCE_CAP) + logarithm)
    evidence = state.evidence.copy()
    evidence[cameras] = _EVIDENCE_KEPT * evidence[cameras] + gain
    state.evidence = evidence


def best_walk(state: State, camera: int) -> int:
    """The walk with the most evidence, the static one left out."""
    return 1 + int(np.argmax(state.evidence[camera, 1:]))


def select_walk(state: State, camera: int) -> None:
    """Select a camera's walk by the evidence.

    During a drift the static sums become outdated. Whenever the evidence is against them, they
    restart from those of the walk, and must gain evidence from there.
    """
    evidence, walk, best = state.evidence[camera], int(state.walk[camera]), best_walk(state, camera)
    if not walk:
        if evidence[best] - evidence[0] > _SELECT:
            follow_drift(state, camera, best)
        return
    if evidence[0] - evidence[walk] > _SELECT:
        state.put(camera, walk=0, evidence=np.zeros_like(evidence))
        return
    if evidence[best] - evidence[walk] > _PREFER_WALK:
        walk = best
        state.put(camera, walk=walk)
    if evidence[walk] - evidence[0] > _PREFER_WALK:
        _restart_static(state, camera)


def _restart_static(state: State, camera: int) -> None:
    """Restart a camera's static sums from those of its walk."""
    walk, evidence = state.walk[camera], state.evidence[camera].copy()
    evidence[0] = evidence[walk]
    walks = state.walks[camera]
    state.put(camera, walks=walks.replace_at(0, walks[walk]), evidence=evidence)


_PATIENCE = 5  # frames more, until the other cameras show whether they moved too
_OUTVOTE = 2  # outlier frames per frame that still agrees with the old estimate
_LEAST_EPOCHS = 1.9  # summarized, before which the scatter of epochs is unknown
_BEFORE = 20.0  # frames before a small step, at least


@dataclass(frozen=True, eq=False)
class DetectedStep:
    """A step of some cameras.

    Attributes:
        since: number of the first frame after it.
        found_by: the cameras whose frames show it.
        outlier_frames: per camera, the frames set aside that agree on its new place.
    """

    since: int
    found_by: frozenset[int]
    outlier_frames: Mapping[int, tuple[Gated, ...]] = field(default_factory=dict)


def detect_step(state: State) -> DetectedStep | None:
    """A step so large that frames after it do not agree with the estimate.

    It is accepted when enough outlier frames agree with each other, and every other camera has had
    as many frames to show whether it moved too.
    """
    needed, cameras = state.config.tracking.step_frames, range(len(state.names))
    clusters = {camera: _cluster(state, camera) for camera in cameras}
    found_by = {
        c: near
        for c, near in clusters.items()
        if len(near) >= needed and len(near) >= _OUTVOTE * _count_agreeing(state, c, near[0].number)
    }
    if not found_by:
        return None
    since = min(near[0].number for near in found_by.values())
    longest = max(len(near) for near in found_by.values())
    waiting = any(
        _count_agreeing(state, c, since) + sum(1 for s in clusters[c] if s.number >= since) < needed
        for c in cameras
        if state.started[c] and state.absent[c] < state.config.tracking.blind_frames
    )
    if waiting and longest < needed + _PATIENCE:
        return None
    return DetectedStep(since, frozenset(found_by), clusters)


def _cluster(state: State, camera: int) -> tuple[Gated, ...]:
    """The outlier frames that agree with the newest one; a single one is no evidence."""
    if not state.outliers[camera]:
        return ()
    T, scale, share = state.outliers[camera][-1].poses[0], state.scales[camera], state.share[camera]
    near = [one for one in state.outliers[camera] if Gated.at(T, one.raw, scale).agrees(share)]
    return tuple(near) if len(near) > 1 else ()


def _count_agreeing(state: State, camera: int, since: int) -> int:
    """Number of frames since a frame number that agree with the estimate."""
    return sum(1 for number, good in state.agreements[camera] if good and number >= since)


def _is_pending(state: State, camera: int) -> bool:
    """Whether the last frame was an outlier frame, and not so many were that they had shown it."""
    last, kept = state.agreements[camera][-1:], state.outliers[camera][-1:]
    apart = sum(not good for _, good in state.agreements[camera])
    few = apart <= state.config.tracking.step_frames + _PATIENCE
    return bool(last and kept and few) and last[0] == (kept[0].number, False)


def detect_small_step(state: State) -> DetectedStep | None:
    """A step so small that frames after it still agree with the estimate, at an epoch's start.

    By whether frames before and after contradict each other; undetermined directions do not count.
    Not while outlier frames may show that it is a large one.
    """
    if any(_is_pending(state, camera) for camera in range(len(state.names))):
        return None
    edges, detected, best = state.edges, None, 1.0
    after = Sums(np.cumsum(state.sums_of_epochs().packed[::-1], axis=0)[::-1])
    before = state.sums_before_epochs()[:-1]
    ready = state.started & (state.groups[:, 0] >= _LEAST_EPOCHS)
    tested = (before.frames >= _BEFORE) & (after.frames > 0) & ready
    tested &= np.array(state.sizes)[:, None] > 0
    tested[0] = False
    tested[tested] = before[tested].are_determined
    begun, cameras = (index.tolist() for index in np.nonzero(tested))
    before, later = before[tested], after[tested]
    score, covariance = _predict(before, later)
    covariance += before.scatter * (later.frames / (before.frames - 1))[:, None, None]
    covariance *= inflation(state.groups[cameras])[:, None, None]
    limits = alarm_limit(before.frames)
    sigmas = np.linalg.solve(covariance, score[..., None])[..., 0]
    excess = (score * sigmas).sum(axis=1) / limits
    for row in np.flatnonzero(excess > 1.0):
        camera, first = cameras[row], edges[begun[row]]
        own, hessian = pose_rows(camera), later.hessian[row]
        if excess[row] > best:  # by what places share it is less still
            by_places = hessian @ shift_between(state, first)[own, own] @ hessian
            squared = squared_sigmas(score[row], covariance[row] + by_places)
            if squared / limits[row] > best:
                best = squared / limits[row]
                detected = DetectedStep(int(state.numbers[first]), frozenset([camera]))
    return detected


def _predict(before: Sums, after: Sums) -> tuple[Array, Array]:
    """(..., 6) gradients of the frames after, at the minimum of those before.

    Further (..., 6, 6) their covariances by that minimum's.
    """
    spread = np.linalg.solve(before.hessian, after.hessian)
    step = np.linalg.solve(before.hessian, -before.gradient[..., None])
    score = after.gradient + (after.hessian @ step)[..., 0]
    return score, spread.swapaxes(-1, -2) @ before.scatter @ spread


_RECENTLY = 300  # frames: a second small step within them is a drift
_GUESSED_OVERCONFIDENCE = 100.0  # of H, while the frames' scatter is not known
_FOLLOWING = 2  # the least walk by which a change is followed: the configured one
_OLD_SHARE = 0.25  # of the live epochs: a change before their end came slowly


def handle_small_step(state: State, detected: DetectedStep) -> list[Event]:
    """Restart after a small step, or follow a drift if it was slow.

    A change that lies as far back as the live epochs go, or comes soon after another one, came
    slowly: a step would have been detected earlier, or at once.
    """
    (camera,) = detected.found_by
    moved_at = int(state.moved_at[camera])
    recently = moved_at >= 0 and state.updates - moved_at < _RECENTLY
    old = state.edges[int(_OLD_SHARE * (len(state.sizes) - 1))]
    if detected.since > state.numbers[old] and not recently:
        return restart_after_step(state, detected)
    follow_drift(state, camera, max(best_walk(state, camera), _FOLLOWING))
    return []


def restart_after_step(state: State, detected: DetectedStep) -> list[Event]:
    """Restart the cameras that have moved in a step; the events."""
    detected, (steps, now) = _date_step(state, detected)
    cause = find_cause(steps, detected.found_by)
    found = {None: cause.lidar} if cause.lidar else {c: steps.of(c) for c in cause.cameras}
    events = [
        _event(state, "moved", detected.since, (who, Size.of(*step))) for who, step in found.items()
    ]
    to = retract_all(state.references, now)
    targets = {camera: to[camera] for camera in cause.cameras}
    if cause.lidar:
        by = invert(gtsam.Pose3.Expmap(cause.lidar[0]).matrix())
        others = set(range(len(state.names))) - set(targets)
        targets |= {camera: state.references[camera] @ by for camera in others}
    for camera in detected.found_by - set(steps.cameras):  # nothing to compare with
        if near := detected.outlier_frames.get(camera):
            targets[camera] = near[-1].poses[0]
    for camera, T_camera_lidar in targets.items():
        _restart_camera(state, detected, camera, T_camera_lidar)
    if not cause.lidar:  # the relative poses of cameras that moved alone are wrong
        moved = {state.names[camera] for camera in targets}
        pairs = enumerate(state.rig.relative_poses)
        wrong = {place for place, pair in pairs if moved & {pair.a, pair.b}}
        state.dropped_pairs = tuple(sorted({*state.dropped_pairs} | wrong))
    state.with_moves(events)
    return events


def _date_step(state: State, detected: DetectedStep) -> tuple[DetectedStep, Measured]:
    """The step with its first frame: the one from which the new estimates fit better.

    With it, what :func:`_measure_steps` gives for it.
    """
    measured = steps, now = _measure_steps(state, detected)
    found_by = [camera for camera in detected.found_by if camera in steps.cameras]
    numbers, gain = state.numbers.tolist(), np.full(len(state.numbers), np.nan)
    for camera in found_by:
        raw = _matches_since(state, replace(detected, since=numbers[0]), camera)
        assert raw is not None  # by which it is found
        ends = np.stack([now[camera] - steps.of(camera)[0], now[camera]])
        runs = to_runs(raw.frame_edges)
        before, after = (
            raw.with_scale(state.scales[camera]).summarize(np.tile(T, (len(runs), 1, 1)), runs).cost
            for T in retract_all(np.tile(state.references[camera], (2, 1, 1)), ends)
        )
        rows = np.searchsorted(numbers, raw.frame_numbers)
        gain[rows] = np.nan_to_num(gain[rows]) + before - after
    place = state.first_row(detected.since)
    while place > 0 and gain[place - 1] > 0:
        place -= 1
    while place < len(numbers) - 1 and gain[place] <= 0:
        place += 1
    since = numbers[min(place, len(numbers) - 1)]
    if since == detected.since:
        return detected, measured
    dated = replace(detected, since=since)
    remeasured = _measure_steps(state, dated)
    if set(found_by) <= set(remeasured[0].cameras):
        return dated, remeasured
    return detected, measured


def _restart_camera(
    state: State, detected: DetectedStep, camera: int, T_camera_lidar: Array
) -> None:
    """Restart a camera at T_camera_lidar from the frames since it moved."""
    raw = _matches_since(state, detected, camera)
    if raw is not None:
        set_aside = [one.number for one in state.outliers[camera]]
        state.count(camera, left_out=-int(np.isin(raw.frame_numbers, set_aside).sum()))
    (step,) = logarithms((state.references[camera] @ invert(T_camera_lidar))[None])
    drift = state.drift
    if drift is not None:
        steps = np.where(np.arange(len(state.names))[:, None] == camera, step, 0.0)
        state.drift = None if drift.camera == camera else drift.about(steps)
    state.sums = state.sums.replace_at((slice(None), camera), Sums.zeros())
    state.places = state.places.without(camera)
    state.put(
        camera,
        matches=(), outliers=(), agreements=(), moved_at=state.updates, absent=0,
        walks=Sums.zeros(len(STRENGTHS)), evidence=0.0, walk=0,
    )  # fmt: skip
    absorb_again(state, camera, raw, T_camera_lidar)


def _matches_since(state: State, detected: DetectedStep, camera: int) -> CameraBlock | None:
    """A camera's matches in the frames since a step, including those set aside; None: no frame."""
    own, outliers = state.matches_of(camera), detected.outlier_frames.get(camera, ())
    parts = [one.raw for one in (*(() if own is None else (own,)), *outliers)]
    kept = [raw.select(raw.frame >= detected.since) for raw in parts]
    if not sum(map(len, kept)):
        return None
    raw = merge([raw for raw in kept if len(raw)])
    return raw.select(np.argsort(raw.frame, kind="stable"))


def _sums_since(state: State, detected: DetectedStep) -> Sums:
    """The sums over the frames since a step, linearized at the estimate that fits them."""
    found = Sums.zeros(len(state.names))
    for camera in np.flatnonzero(state.started).tolist():
        raw = _matches_since(state, detected, camera)
        if raw is None:
            continue
        near, scale = detected.outlier_frames.get(camera, ()), state.scales[camera]
        start = near[-1].poses[0] if near else state.references[camera]
        gated = Gated.at(refine(raw, start, scale, state.config), raw, scale)
        if gated.counts.sum() >= MIN_MATCHES:
            found = found.replace_at(camera, sums_of(state, {camera: gated}).total())
    return found


def _measure_steps(state: State, detected: DetectedStep) -> Measured:
    """The steps of the cameras; and per camera its estimate now, from its reference."""
    before, after = state.all_sums(detected.since), _sums_since(state, detected)
    new = np.flatnonzero(~state.is_known).tolist()
    guessed = {camera: after.hessian[camera] * _GUESSED_OVERCONFIDENCE for camera in new}
    own = {camera: before.scatter[camera] for camera in (*new, *state.drifting)}
    by_places = shift_between(state, state.first_row(detected.since))
    return steps_between(state, (before, own), (after, guessed), by_places)
