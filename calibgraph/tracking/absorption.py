"""Frames in the state: absorbed, left out, or without usable matches; and a camera's start."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Rig
from calibgraph.pipeline import solve
from calibgraph.solver.columns import distortion_evidence
from calibgraph.solver.lens import considered_lens, error_by_lens, error_by_travel, lens_columns
from calibgraph.solver.matches import CameraBlock, camera_blocks
from calibgraph.solver.pnp import frame_pose
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.cause import chance_limit
from calibgraph.tracking.estimate import EpochGraph, states_places
from calibgraph.tracking.events import Event
from calibgraph.tracking.frames import StreamFrame, findings_of
from calibgraph.tracking.gate import Gated, refine
from calibgraph.tracking.state import BEND, COUNTS, HISTORY, State
from calibgraph.tracking.sums import Sums
from factors import BlockSums, to_runs
from factors.pose_kernel import logarithms

_LAST_FRAMES = 20  # of which it is kept whether they agree with the estimate
_UNUSUAL = 25.0  # squared sigmas of a six-vector
_TOTAL_KEPT = 1 - 1 / 2000  # of the total scatter, from frame to frame
_SEEN = 3000  # at most, of the matches whose directions and distances are those of scenes
_LENS_KEPT = 0.7  # of the errors by a lens, from epoch to epoch: scenes drawn for one scatter


def begin_frames(state: State, frames: Sequence[StreamFrame]) -> None:
    """Begin frames, none of whose matches is absorbed."""
    last, n = frames[-1], len(state.names)
    tables = [one.table for one in frames if len(one.table)][-1:]
    state.stamp_ns = last.stamp_ns
    state.updates += len(frames)
    for table in tables:
        state.motion = table.motion_column
        if table.findings != state.findings:
            new = findings_of(table.findings)
            state.findings = state.findings if new == state.findings else new
    numbers = np.array([one.frame for one in frames], dtype=np.int64)
    state.numbers = np.concatenate([state.numbers, numbers])
    state.at = (*state.at, *(str(one.place) for one in frames))
    state.sizes = (*state.sizes[:-1], state.sizes[-1] + len(frames))
    none = Sums.zeros(len(frames), n).packed
    state.sums = Sums(np.concatenate([state.sums.packed, none]))


def absorb(state: State, gated: Mapping[int, Gated]) -> None:
    """Take in the inliers of frames that have begun; frames with too few of them are left out."""
    kept = {camera: one.select(one.enough) for camera, one in gated.items() if one.enough.any()}
    if not kept:
        return
    cameras = np.repeat([*kept], [one.raw.frames for one in kept.values()])
    numbers = np.concatenate([one.raw.frame_numbers for one in kept.values()])
    rows = np.searchsorted(state.numbers, numbers)
    state.sums = state.sums.replace_at((rows, cameras), sums_of(state, kept))
    for camera, one in kept.items():
        agreed = ((number, True) for number in one.raw.frame_numbers.tolist())
        state.put(
            camera,
            matches=(*state.matches[camera], one),
            agreements=(*state.agreements[camera], *agreed)[-_LAST_FRAMES:],
        )
        given, used, absorbed = len(one.inliers), int(one.counts.sum()), one.raw.frames
        state.count(camera, given=given, used=used, absorbed=absorbed)


def sums_of(state: State, gated: Mapping[int, Gated]) -> Sums:
    """(f,) sums of the inliers in the frames of each camera in turn, about its reference.

    The true Hessian of few matches is noise, and may not be definite: its ratio to the one by
    weights is that of all frames.

    Args:
        state: with the scales of the residuals, and how curved their cost is.
        gated: by camera; linearized at its poses.
    """
    parts, cameras = [], list[int]()
    for camera, own in gated.items():
        edges = np.concatenate([[0], own.counts.cumsum().astype(np.int64)])
        block = own.inside.with_scale(state.scales[camera])
        parts.append(block.summarize(own.poses, to_runs(edges)))
        cameras += [camera] * own.raw.frames
    here, to = BlockSums.join(parts), state.references[cameras]
    poses = np.concatenate([own.poses for own in gated.values()])
    root = np.linalg.cholesky(here.hessian + WEAK)
    hessian = root @ state.curvature[cameras] @ root.swapaxes(1, 2)
    gradient = here.gradient
    if not np.array_equal(poses, to):
        steps = logarithms(poses @ invert(to))
        gradient = gradient + (hessian @ steps[..., None])[..., 0]
    return Sums.zeros(len(cameras)).change(
        hessian=hessian,
        gradient=gradient,
        reweighted=here.hessian,
        score=gradient,
        scatter=gradient[:, :, None] * gradient[:, None, :],
        frames=np.ones(len(cameras)),
        matches=np.concatenate([own.counts for own in gated.values()]),
    )


def add_to_totals(state: State, frames: Sums) -> None:
    """Add (f, n) frames to the scatter of all frames, in their order.

    An unusual frame is down-weighted: it may come after a move that has not been detected yet.
    """
    count, scores = len(frames.packed), frames.score.copy()
    known = state.is_known
    own = scores[:, known]
    unusual = (own * np.linalg.solve(state.frame_noise[known], own[..., None])[..., 0]).sum(axis=-1)
    scores[:, known] = own * np.sqrt(_UNUSUAL / np.maximum(unusual, _UNUSUAL))[..., None]
    ages, kept = _TOTAL_KEPT ** np.arange(count - 1.0, -1.0, -1.0), _TOTAL_KEPT**count
    flat = scores.reshape(count, -1)
    state.total = kept * state.total + (ages * flat.T) @ flat
    state.total_hessian = kept * state.total_hessian + np.tensordot(ages, frames.hessian, axes=1)
    state.total_frames = kept * state.total_frames + ages @ frames.frames


def select_agreeing(
    state: State, graph: EpochGraph, gated: Mapping[int, Gated]
) -> dict[int, Gated]:
    """The matches of one frame in cameras where it agrees with the estimate; others are set aside.

    One that agrees with the pose of its place does, too; it is gated there.
    """
    agreeing = {}
    for camera, one in gated.items():
        if one.agrees(state.share[camera]):
            agreeing[camera] = one
            continue
        own = _gated_alone(state, camera, one.raw)
        if own is not None and _is_at_its_place(state, graph, camera, own):
            agreeing[camera] = own
        else:
            _set_aside(state, camera, own)
    return agreeing


def _gated_alone(state: State, camera: int, raw: CameraBlock) -> Gated | None:
    """A frame at its own T_camera_lidar; None if none explains it, so the matching failed."""
    for start in _starts(state, camera, raw):
        T = refine(raw, start, state.scales[camera], state.config)
        own = Gated.at(T, raw, state.scales[camera])
        if own.agrees(state.share[camera]):
            return own
    return None


def _starts(state: State, camera: int, raw: CameraBlock) -> Iterator[Array]:
    """Start values for the frame's own T_camera_lidar: the estimate; then PnP, if possible.

    PnP takes several times as long as a fit from the estimate, which is mostly near enough. Both
    end at the same minimum where most of the usual share of matches agrees.
    """
    yield state.references[camera]
    if raw.information is not None or state.config.stage1 == "rig":
        return
    by_pnp = frame_pose(state.rig.cameras[state.names[camera]], raw.block, state.config)
    if by_pnp is not None:
        yield by_pnp


def _is_at_its_place(state: State, graph: EpochGraph, camera: int, own: Gated) -> bool:
    """Whether a frame that disagrees with a camera's estimate agrees with the pose of its place.

    In the graph with this frame: if its place is displaced by no more than places are, and the
    pose there explains it.
    """
    if state.walk[camera] or not states_places(state):
        return False
    tried = state.draft()
    tried.sums = state.sums.replace_at((-1, camera), sums_of(state, {camera: own})[0])
    squared, T = graph.at_its_place(tried)
    if squared[0] + squared[1 + camera] > chance_limit():
        return False
    return Gated.at(T[camera], own.raw, state.scales[camera]).agrees(state.share[camera])


def _set_aside(state: State, camera: int, own: Gated | None) -> None:
    """Count a camera's frame as left out.

    It is kept as an outlier frame if another T_camera_lidar explains it; otherwise the matching has
    failed.
    """
    kept, number = state.outliers[camera], int(state.numbers[-1])
    state.put(
        camera,
        outliers=kept if own is None else (*kept, own)[-_LAST_FRAMES:],
        agreements=(*state.agreements[camera], (number, False))[-_LAST_FRAMES:],
    )
    state.count(camera, left_out=1, failed=1 if own is None else 0)


def count_repeats(state: State, given: Correspondences, again: Collection[int]) -> None:
    """Count the frames in a row, per camera, that repeat the one before them.

    Args:
        state: of the tracker.
        given: the correspondences of a frame.
        again: numbers of its cameras that repeat.
    """
    before = state.counts[:, COUNTS.index("repeated")]
    if not again and not before.any():
        return
    for number in np.unique(given.camera_index).tolist():
        camera = state.names.index(given.cameras[number])
        state.count(camera, repeated=1 if number in again else -int(before[camera]))


def count_absent(state: State, used: Collection[int], frame: StreamFrame) -> list[Event]:
    """Count the frames without usable matches; the events ``blind`` and ``back``.

    Args:
        state: after a frame, or more.
        used: the cameras whose matches of the frame were absorbed, by their places in the rig.
        frame: this one.
    """
    events, limit, number = [], state.config.tracking.blind_frames, frame.frame
    absent = state.absent + state.started
    absent[[*used]] = 0
    for camera in np.flatnonzero(state.started & (absent != state.absent)).tolist():
        name = state.names[camera]
        if absent[camera] == limit:
            numbers = state.numbers[state.numbers <= number]
            since = int(numbers[-min(limit, len(numbers))])
            events.append(Event("blind", name, since, number, frame.stamp_ns))
        if absent[camera] == 0 and state.absent[camera] >= limit:
            events.append(Event("back", name, number, number, frame.stamp_ns))
    state.absent = absent
    return events


# A camera's first estimate: the batch solve of its first frames.


def start_cameras(state: State, table: Correspondences, seen: Collection[int]) -> list[Event]:
    """Try to start the cameras that have no estimate yet, after one more frame.

    Args:
        state: of the tracker.
        table: the correspondences of the frame.
        seen: the cameras that have enough of them.
    """
    events, every = [], min(state.config.tracking.start_frames, HISTORY)
    for camera in (camera for camera in seen if not state.started[camera]):
        name, number = state.names[camera], int(state.numbers[-1])
        own = table.of_camera(name).with_metadata(findings_of(table.findings).to_metadata())
        waiting = (*state.waiting[camera], own)
        state.put(camera, waiting=waiting[-HISTORY:])
        if len(waiting) % every:
            continue
        state.put(camera, refused=_try_to_start(state, camera))
        if state.started[camera]:
            events.append(Event("started", name, number, number, state.stamp_ns))
        elif len(waiting) >= HISTORY:  # tried with a full window: the older half is dropped
            state.put(camera, waiting=waiting[HISTORY // 2 - HISTORY :])
    return events


def _try_to_start(state: State, camera: int) -> tuple[str, ...]:
    """Start a camera by the batch solve of its first frames; the reasons if it fails."""
    name = state.names[camera]
    rig = Rig(lidar=state.rig.lidar, cameras={name: state.rig.cameras[name]})
    try:
        result = solve(rig, concatenate(state.waiting[camera]), state.config)
    except CorrespondenceError as error:
        return (str(error),)
    if result.verdict.status == "FAIL":
        return result.camera_verdicts[name].reasons
    _start_camera(state, camera, result.T_camera_lidar[name])
    return ()


def _start_camera(state: State, camera: int, T_camera_lidar: Array) -> None:
    """Absorb a camera's first frames at its first estimate."""
    kept = preprocess(state.rig, concatenate(state.waiting[camera]), state.config)
    raw = camera_blocks(state.rig, kept.table, state.config)[state.names[camera]]
    scale = raw.scale(T_camera_lidar, state.config)
    gated = Gated.at(T_camera_lidar, raw, scale)
    curvature = gated.curvature(T_camera_lidar, scale)
    state.put(
        camera,
        started=True, waiting=(), references=T_camera_lidar,
        scales=scale, share=gated.usual_share, curvature=curvature,
    )  # fmt: skip
    _consider_lens(state, camera, gated.inside)
    absorb_again(state, camera, raw, T_camera_lidar)


def count_epoch(state: State, camera: int, first: int) -> None:
    """Count what a camera's matches since a frame show of its lens, and of the scan distortion."""
    own = state.matches_of(camera)
    if own is None:
        return
    recent = own.raw.select(own.inliers & (own.raw.frame >= first))
    if len(recent):
        bends = state.bends[camera] + _bends_of(state, camera, recent)
        state.put(camera, lens=_consider_lens(state, camera, recent), bends=bends)


def _consider_lens(state: State, camera: int, matches: CameraBlock) -> Array:
    """What may err of a camera's lens, by some matches and closed epochs; (6, 6 + k) of both."""
    of, T = state.rig.cameras[state.names[camera]], state.references[camera]
    block, before = matches.with_scale(state.scales[camera]), state.lens[camera]
    lens = considered_lens(of, block)
    columns = lens_columns(lens, block, T)
    if before.shape == columns.shape:  # else motion became known, or none yet
        columns = columns + before
    kept = state.matches_of(camera)  # in more directions than those of one epoch
    seen = matches if kept is None else kept.raw.select_evenly(_SEEN)
    found = error_by_lens(lens, columns, seen.block, T, of=state.config.of)
    errors = np.zeros((6, 6)) if found is None else found
    if (known := state.lens_errors[camera]).any():
        errors = _LENS_KEPT * known + (1 - _LENS_KEPT) * errors
    state.put(camera, lens_errors=errors, travel=error_by_travel(seen.block, T))
    return columns


def _bends_of(state: State, camera: int, matches: CameraBlock) -> Array:
    """(66,) see BEND, of some matches.

    At each place the camera has a pose of its own. What no such pose can follow is left in the
    residuals, at whatever estimate: so it holds on when a camera moves or drifts.
    """
    if not any(state.findings.bend_sigmas):
        return np.zeros(BEND)
    numbers = matches.frame_numbers
    at = np.array(state.at)[np.searchsorted(state.numbers, numbers)]
    places = [numbers[at == name] for name in dict.fromkeys(at.tolist())]
    T = state.references[camera]
    one = distortion_evidence(matches, state.scales[camera], T, WEAK, places=places)
    parts = one.hessian, one.hessian @ one.jacobian, one.information, one.vector
    return np.concatenate([part.ravel() for part in parts])


def absorb_again(state: State, camera: int, raw: CameraBlock | None, T_camera_lidar: Array) -> None:
    """Absorb matches of frames that are kept, in their order, with the camera at a new estimate."""
    state.put(camera, references=T_camera_lidar)
    state.settled, state.steps = (), state.steps[:0]
    state.weights, state.shared = state.weights[:0], np.zeros_like(state.shared)
    if raw is not None:
        raw = raw.select(np.isin(raw.frame, state.numbers))
        if len(raw):
            absorb(state, {camera: Gated.at(T_camera_lidar, raw, state.scales[camera])})
    own, bends = state.matches_of(camera), state.bends[camera].copy()
    bends[:54] = 0.0  # the matches follow the distortion in another way
    if own is not None:
        bends[:54] = _bends_of(state, camera, own.inside)[:54]
    state.put(camera, bends=bends)
