"""The walk of time offsets from place to place: a chain in the graph of the closed epochs.

    walk    e_cp, the offset as the frames of place p show it, to that of the next place in time,
            and the last to s_c: stock ``BetweenFactorVector``s

A row of sums per place holds its offset as it was when the place was left. While a place is the
present one, the walk within it widens its row; so does the way back of a place that is seen again.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from operator import itemgetter

import gtsam
import numpy as np

from calibgraph.graph.by_place import QuadraticByPlace
from calibgraph.graph.lens import LensTerm, walk_graph
from calibgraph.graph.variables import MOST_CAMERAS, seen_lens_at_key, seen_lens_key
from calibgraph.tracking.offset_sums import after_offset_walk
from calibgraph.tracking.place_sums import MOST_PLACES, PlaceSums, sums_by_place
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums

Times = Mapping[str, int]
"""Per place, in frames of closed epochs, when its offsets are as its row of sums has them."""
Walk = tuple[tuple[int, float], ...]


def times_of(state: State) -> Times:
    """Those of all closed epochs; none where offsets are not estimated."""
    if state.offsets is None:
        return {}
    times = dict(state.offsets.times)
    for epoch in state.epochs[:-1]:
        now = _latest(times) + len(epoch.frames)
        times |= dict.fromkeys((frame.place for frame in epoch.frames), now)
    return times


def times_with(times: Times, names: Collection[str]) -> Times:
    """The times with places that are at the present."""
    return {**times, **dict.fromkeys(names, _latest(times))}


def walked(state: State, sums: PlaceSums, frames: Mapping[str, int]) -> PlaceSums:
    """The sums after the walk of the offsets over some frames, at places of some names."""
    rows = [row for row, name in enumerate(sums.names) if frames.get(name)]
    if not rows:
        return sums
    none = np.zeros(1)
    variance = np.stack([state.walk_variance(none, frames[sums.names[row]]) for row in rows])
    after = after_offset_walk(sums.rows[rows], variance, state.all_overconfidence)
    return replace(sums, rows=sums.rows.replace_at(rows, after))


def to_present(state: State, sums: PlaceSums, times: Times, names: Collection[str]) -> PlaceSums:
    """The sums with the offsets at some places as they are now."""
    now = _latest(times)
    return walked(state, sums, {name: now - times[name] for name in names if name in times})


def add_epoch(
    state: State, sums: PlaceSums, times: Times, *, parts: Mapping[str, Sums], frames: int
) -> tuple[PlaceSums, Times]:
    """The sums with those of an epoch's places added, and the walk over its frames after it."""
    now = _latest(times)
    sums = to_present(state, sums, times, parts.keys()).add(parts)
    sums = walked(state, sums, dict.fromkeys(parts, frames))
    return sums, {**times, **dict.fromkeys(parts, now + frames)}


def bounded(state: State, sums: PlaceSums, times: Times) -> tuple[PlaceSums, Times]:
    """The sums with at most ``MOST_PLACES``: the older row has the offset of its last place."""
    times = dict(times)
    while len(sums.names) > 1 + MOST_PLACES:
        older, second, *_ = sums.names
        since = times[second] - times.get(older, times[second])
        sums = walked(state, sums, {older: since}).bounded(len(sums.names) - 2)
        times[older] = times.pop(second)
    return sums, times


def _latest(times: Times) -> int:
    return max(times.values(), default=0)


def at_own_times(
    camera: int, matches: QuadraticByPlace, names: Sequence[str], times: Times
) -> QuadraticByPlace:
    """A camera's quadratics at places of some names, each on the offset of its own time."""
    now = _latest(times)
    keys = [
        seen_lens_at_key(int(place), camera) if times[names[place]] < now else key
        for place, key in zip(matches.places, matches.keys, strict=True)
    ]
    return replace(matches, keys=keys)


def walk_of(
    camera: int, matches: QuadraticByPlace, names: Sequence[str], times: Times, *, step: float
) -> Walk:
    """The walk of the offsets of these quadratics, with its variance over a frame."""
    at = {key: times[names[place]] for place, key in zip(matches.places, matches.keys, strict=True)}
    at[seen_lens_key(camera)] = _latest(times)
    ordered = sorted(at.items(), key=itemgetter(1))
    pairs = pairwise(ordered)
    return tuple((key, step * (later - time)) for (key, time), (_, later) in pairs)


def in_order_of_time(times: Times, names: Sequence[str]) -> tuple[list[int], list[int]]:
    """How to sort places of some names, and the frames from each to the next, or to the present."""
    at = [times[name] for name in names]
    order = sorted(range(len(at)), key=at.__getitem__)
    until = [*(at[row] for row in order), _latest(times)][1:]
    return order, [later - at[row] for row, later in zip(order, until, strict=True)]


def walks_at(
    lenses: Mapping[int, LensTerm], kept: Collection[int]
) -> tuple[gtsam.NonlinearFactorGraph, list[int]]:
    """The walk of all cameras over some of their places, and the keys of the offsets there."""
    graph, keys = gtsam.NonlinearFactorGraph(), list[int]()
    for number, term in lenses.items():
        walk = list[tuple[int, float]]()
        for key, variance in term.walk:
            if gtsam.symbolIndex(key) // MOST_CAMERAS in kept:
                walk.append((key, variance))
            elif walk:
                walk[-1] = walk[-1][0], walk[-1][1] + variance
        graph.push_back(walk_graph(number, walk))
        keys += [key for key, _ in walk]
    return graph, keys


def sums_in_time(state: State) -> PlaceSums:
    """The sums of closed epochs, each place at the time offset that it was left with."""
    assert state.offsets is not None
    sums, times = state.places, state.offsets.times
    for epoch in state.epochs[:-1]:
        parts, frames = sums_by_place(epoch.frames), len(epoch.frames)
        sums, times = add_epoch(state, sums, times, parts=parts, frames=frames)
    return sums
