"""The end of an epoch: a new gate and linearization at the newest estimate, and a new epoch."""

from __future__ import annotations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert, retract_all
from calibgraph.solver.robust import median_norm
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.absorption import add_to_totals, count_epoch, sums_of
from calibgraph.tracking.estimate import EpochGraph, locate_places
from calibgraph.tracking.events import Event
from calibgraph.tracking.gate import Gated
from calibgraph.tracking.moves import report_drift, select_walk, shift_between, update_evidence
from calibgraph.tracking.state import STRENGTHS, State
from calibgraph.tracking.sums import Numbers
from factors import BlockSums, to_runs
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
    steady = state.walk == 0
    if len(state.sizes) > state.config.tracking.live_epochs:
        _summarize_oldest(state)
    _set_references(state, newest)
    first = int(state.numbers[state.closed])
    places = state.settled_rows(state.at)
    for camera in range(len(state.names)):
        _regate(state, camera, places, is_steady=bool(steady[camera]))
        count_epoch(state, camera, first)
    state.sizes = (*state.sizes, 0)
    return report_drift(state)


def _newest(state: State, graph: EpochGraph) -> Array:
    """(n, 4, 4) T_camera_lidar at the minimum of each camera's matches, where the gate is drawn.

    Of all that are kept, as in a batch: that of the matches within a gate is drawn to where the
    gate was before. Of a camera that drifts, or has none, that of Eq. 5.
    """
    newest = retract_all(state.references, graph.equation_5(state.all_sums()))
    own = {c: state.matches_of(c) for c in np.flatnonzero(state.walk == 0).tolist()}
    blocks = {c: one.raw.with_scale(state.scales[c]) for c, one in own.items() if one is not None}
    cameras = [*blocks]
    older, start = state.walks[cameras, 0], state.references[cameras]
    at = start
    for _ in range(_GATE_STEPS if cameras else 0):
        pairs = zip(blocks.values(), at, strict=True)
        found = BlockSums.join([block.summarize(T[None]) for block, T in pairs])
        moved = older.shift_reference(logarithms(start @ invert(at)))
        pull, whole = found.gradient + moved.gradient, found.hessian + older.hessian + WEAK
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
    state.sums = state.sums.shift_reference(steps)
    state.places = state.places.shift_reference(steps)
    state.walks = state.walks.shift_reference(steps[:, None])
    state.steps, state.shared = state.steps - steps, state.shared - steps
    if state.drift is not None:
        state.drift = state.drift.about(steps)


def _regate(state: State, camera: int, places: Numbers, *, is_steady: bool) -> None:
    """Measure the residuals of a camera's frames at the newest estimates, gate and linearize them.

    Each at the pose that its place has, if that is known; of a drifting camera, at its epoch's.
    Frames with too few matches within the gate keep those that were.

    Args:
        state: of the tracker.
        camera: by its place in the rig.
        places: (R,) rows of the frames' places in ``state.steps``; -1: not known.
        is_steady: whether it did not drift until now: its newest estimate is that of all frames.
    """
    own, reference = state.matches_of(camera), state.references[camera]
    if own is None:
        return
    raw, scale, poses = own.raw, state.scales[camera], own.poses.copy()
    rows = np.searchsorted(state.numbers, raw.frame_numbers)
    newest = rows >= state.closed
    poses[newest | is_steady] = reference
    sizes_px, sizes = raw.all_sizes(poses, to_runs(raw.frame_edges))
    if raw.frames >= state.config.tracking.epoch_frames:
        scale = raw.scale_of(sizes_px, sizes, state.config)
    at = poses
    if not state.walk[camera]:
        steps = np.zeros((len(rows), 6))
        if state.config.preset == "auto":  # Eq. 5 knows no places
            steps = np.concatenate([state.steps[:, camera], steps[:1]])[places[rows]]
        at = retract_all(reference[None].repeat(len(rows), axis=0), steps)
    gated = Gated(raw, sizes_px * median_norm(raw.information) <= scale.gate_px, at)
    state.put(camera, scales=scale, share=gated.usual_share)
    if (shown := gated.select(newest) if state.walk[camera] else gated).enough.any():
        state.put(camera, curvature=shown.curvature(reference, scale))
    if not gated.enough.all():
        within = np.where(np.repeat(gated.enough, raw.frame_counts), gated.inliers, own.inliers)
        gated = Gated(raw, within, at)
    state.put(camera, matches=(Gated(raw, gated.inliers, poses),))
    state.sums = state.sums.replace_at((rows, camera), sums_of(state, {camera: gated}))


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
        if (own := state.matches_of(camera)) is not None:
            kept = own.raw.frame_numbers > state.numbers[size - 1]
            state.put(camera, matches=(own.select(kept),) if kept.any() else ())
    variance, walks = state.walk_variance(STRENGTHS, size), state.walks + epoch[:, None]
    state.walks = walks.after_walk(variance, state.overconfidence[:, None])
    state.places = state.places.add(names, frames).bounded()
    for camera, before in enumerate(drifted):
        if state.walk[camera]:
            state.places = state.places.without(camera)
        elif before:  # what is left of the drift counts as of one place
            left = state.walks[camera, 0]
            state.places = state.places.with_camera_at(names[-1], camera, left)
    state.numbers, state.at = state.numbers[size:], state.at[size:]
    state.sums, state.sizes = state.sums[size:], state.sizes[1:]
