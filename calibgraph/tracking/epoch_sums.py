"""Sums over epochs, older ones discounted by the random walk of a camera that drifts."""

from __future__ import annotations

from collections.abc import Iterator

from calibgraph.tracking.epoch_summary import STRENGTHS
from calibgraph.tracking.live_frames import Epoch
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums


def sum_epochs(state: State, before: int | None = None) -> Sums:
    """(n,) over all frames, or those before a frame's number."""
    return sum_closed_epochs(state, before) + _until(state.epochs[-1], before)


def sums_before_epochs(state: State) -> Iterator[Sums]:
    """(n,) over the frames before each live epoch."""
    sums = Sums.stack([one.summary.selected for one in state.cameras])
    for epoch in state.epochs:
        yield sums
        sums = _after_epoch(state, sums + epoch.sums, epoch)


def sum_closed_epochs(state: State, before: int | None = None) -> Sums:
    """The same without the frames of the open epoch."""
    sums = Sums.stack([one.summary.selected for one in state.cameras])
    for epoch in state.epochs[:-1]:
        sums = _after_epoch(state, sums + _until(epoch, before), epoch)
    return sums


def _after_epoch(state: State, sums: Sums, epoch: Epoch) -> Sums:
    """The sums after the random walk of an epoch."""
    walks = [one.summary.walk for one in state.cameras]
    if not any(walks):
        return sums
    variance = state.walk_variance(STRENGTHS[walks], len(epoch.frames))
    return sums.after_walk(variance, state.all_overconfidence)[0]


def _until(epoch: Epoch, number: int | None) -> Sums:
    earlier = [frame for frame in epoch.frames if number is None or frame.number < number]
    return epoch.sums if len(earlier) == len(epoch.frames) else epoch.sums_of(earlier)
