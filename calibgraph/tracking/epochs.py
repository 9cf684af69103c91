"""The end of an epoch: a new gate and linearization at the newest estimate, and a new epoch."""

from __future__ import annotations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import (
    invert,
    retract_all,
    to_T_lidar_camera,
)
from calibgraph.solver.robust import median_norm, robust_spread, scale_from
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.absorption import add_to_totals, count_epoch
from calibgraph.tracking.estimate import EpochGraph, locate_places
from calibgraph.tracking.events import Event
from calibgraph.tracking.gate import Gated, sums_of
from calibgraph.tracking.moves import report_drift, select_walk, shift_between, update_evidence
from calibgraph.tracking.state import STRENGTHS, State
from calibgraph.tracking.sums import Numbers, Sums
from factors import to_runs
from factors.pose_kernel import logarithms

_GATE_STEPS = 4  # by the Hessian by weights, which descend: each leaves a fifth of the way
_SMALL_STEP = 1e-2  # squared sigmas of independent matches


def close_epoch(state: State, graph: EpochGraph) -> list[Event]:
    """Close the open epoch and begin a new one.

    A camera that drifts keeps the estimate of each epoch; any other has the newest in all of them.

    Args:
        state: of the tracker.
        graph: of the epoch.
    """
    locate_places(state, graph)
    add_to_totals(state, state.sums[state.closed :])
    newest = _newest(state, graph)
    steady, poses = state.walk == 0, state.poses.copy()
    poses[-1] = newest
    poses[:, steady] = newest[steady]
    state.poses = poses
    if len(state.sizes) > state.config.tracking.live_epochs:
        _summarize_oldest(state)
    _set_references(state, newest)
    first = int(state.numbers[state.closed])
    row_of = {name: row for row, name in enumerate(state.settled)}
    places = np.array([row_of.get(name, -1) for name in state.at], dtype=np.int64)
    for camera in range(len(state.names)):
        _regate(state, camera, places)
        count_epoch(state, camera, first)
    state.sizes, state.poses = (*state.sizes, 0), np.concatenate([state.poses, newest[None]])
    return report_drift(state)


def _newest(state: State, graph: EpochGraph) -> Array:
    """(n, 4, 4) T_camera_lidar at the minimum of each camera's matches, where the gate is drawn.

    Of all that are kept, as in a batch: that of the matches within a gate is drawn to where the
    gate was before. Of a camera that drifts, or has none, that of Eq. 5.
    """
    newest = retract_all(state.references, graph.equation_5(state.all_sums()))
    own = {c: state.matches_of(c) for c in np.flatnonzero(state.walk == 0).tolist()}
    blocks = {c: one[0].with_scale(state.scales[c]) for c, one in own.items() if one is not None}
    cameras = [*blocks]
    older, start = state.walks[cameras, 0], state.references[cameras]
    at = start
    for _ in range(_GATE_STEPS if cameras else 0):
        poses = map(to_T_lidar_camera, at)
        found = [block.sums(T) for block, T in zip(blocks.values(), poses, strict=True)]
        steps = logarithms(start @ invert(at))[..., None]
        pull = np.array([sums.gradient for sums in found]) + older.gradient
        pull += (older.hessian @ steps)[..., 0]
        whole = np.array([sums.hessian for sums in found]) + older.hessian + WEAK
        step = np.asarray(-np.linalg.solve(whole, pull[..., None])[..., 0])
        at = retract_all(at, step)
        if (step * pull).sum(axis=1).min() > -_SMALL_STEP:
            break
    newest[cameras] = at
    return newest


def _set_references(state: State, references: Array) -> None:
    """Take all sums about other references."""
    steps = logarithms(state.references @ invert(references))
    state.references = references
    state.sums = state.sums.shift_reference(
        np.broadcast_to(steps, (len(state.numbers), *steps.shape))
    )
    state.places = state.places.shift_reference(steps)
    state.walks = state.walks.shift_reference(
        np.broadcast_to(steps[:, None], (*state.walks.frames.shape, 6))
    )
    state.steps, state.shared = state.steps - steps, state.shared - steps
    if state.drift is not None:
        state.drift = state.drift.about(steps)


def _regate(state: State, camera: int, places: Numbers) -> None:
    """Measure the residuals of a camera's frames at the newest estimates, gate and linearize them.

    Each at the pose that its place has, if that is known; of a drifting camera, at its epoch's.
    Frames with too few matches within the gate keep those that were.

    Args:
        state: of the tracker.
        camera: by its place in the rig.
        places: (R,) rows of the frames' places in ``state.steps``; -1: not known.
    """
    own = state.matches_of(camera)
    if own is None:
        return
    raw, frames = own[0], own[0].frame_counts
    rows = np.searchsorted(state.numbers, raw.frame_numbers)
    epochs = np.repeat(np.arange(len(state.sizes)), state.sizes)[rows]
    poses, scale = state.poses[epochs, camera], state.scales[camera]
    sizes_px, sizes = raw.all_sizes(poses, to_runs(raw.frame_edges))
    if raw.frames >= state.config.tracking.epoch_frames:
        least = max(robust_spread(sizes), raw.least_spread)
        scale = scale_from(robust_spread(sizes_px), least, state.config)
    within = sizes_px * median_norm(raw.information) <= scale.gate_px
    starts = raw.frame_edges[:-1]
    gated = Gated(poses[-1:], raw, within, np.add.reduceat(within, starts, dtype=float))
    state.put(camera, scales=scale, share=gated.usual_share)
    newest = gated.select(epochs == epochs[-1]) if state.walk[camera] else gated
    if newest.enough.any():
        state.put(camera, curvature=newest.curvature(scale))
    within = np.where(np.repeat(gated.enough, frames), within, own[1])
    counts = np.add.reduceat(within, starts, dtype=float)
    poses = _linearized_at(state, camera, epochs, places[rows])
    state.put(camera, blocks=(raw,), inliers=(within,))
    sums = sums_of(state, {camera: Gated(poses, raw, within, counts)})
    state.sums = state.sums.replace_at((rows, camera), sums)


def _linearized_at(state: State, camera: int, epochs: Numbers, places: Numbers) -> Array:
    """(f, 4, 4) T_camera_lidar at which the matches of frames are linearized."""
    if state.walk[camera]:
        return np.asarray(state.poses[epochs, camera])
    steps = np.zeros((len(epochs), 6))
    if state.config.preset == "auto":  # Eq. 5 knows no places
        steps = np.concatenate([state.steps[:, camera], steps[:1]])[places]
    return retract_all(np.tile(state.references[camera], (len(steps), 1, 1)), steps)


# The summary of older epochs.


def _summarize_oldest(state: State) -> None:
    """Add the oldest epoch to the summaries."""
    size = state.sizes[0]
    frames, names = state.sums[:size], state.at[:size]
    epoch = frames.total()
    drifted = state.walk > 0
    by_places = shift_between(state, 0, size)
    update_evidence(state, epoch, by_places)
    for camera in range(len(state.names)):
        select_walk(state, camera)
    for camera in range(len(state.names)):
        _drop_oldest(state, camera)
    walks = state.walks + Sums(np.repeat(epoch.packed[:, None], len(STRENGTHS), axis=1))
    variance = state.walk_variance(STRENGTHS, size)
    over = np.repeat(state.overconfidence[:, None], len(STRENGTHS), axis=1)
    state.walks = walks.after_walk(np.broadcast_to(variance, (*over.shape, 6)), over)
    state.places = state.places.add(names, frames).bounded()
    for camera, before in enumerate(drifted):
        if state.walk[camera]:
            state.places = state.places.without(camera)
        elif before:  # what is left of the drift counts as of one place
            own = state.walks[camera, 0]
            state.places = state.places.with_camera_at(names[-1], camera, own)
    state.numbers, state.at = state.numbers[size:], state.at[size:]
    state.sums, state.sizes, state.poses = state.sums[size:], state.sizes[1:], state.poses[1:]


def _drop_oldest(state: State, camera: int) -> None:
    """Drop a camera's matches of the oldest epoch."""
    own = state.matches_of(camera)
    if own is not None:
        kept = own[0].frame > state.numbers[state.sizes[0] - 1]
        left = ((own[0].select(kept),), (own[1][kept],)) if kept.any() else ((), ())
        state.put(camera, blocks=left[0], inliers=left[1])
