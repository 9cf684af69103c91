"""What all frames until now show of each camera, all matches taken for independent."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.tracking.epoch_summary import STRENGTHS
from calibgraph.tracking.live_frames import Epoch
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums


def posterior(state: State, before: int | None = None) -> Sums:
    """(n,) sums over all frames, or those before a frame's number."""
    return closed_posterior(state, before) + _until(state.epochs[-1], before)


def closed_posterior(state: State, before: int | None = None) -> Sums:
    """The same without the frames of the open epoch."""
    sums = _summaries(state)
    for epoch in state.epochs[:-1]:
        sums = _after_epoch(state, sums + _until(epoch, before), epoch)
    return sums


def posteriors_before_epochs(state: State) -> Iterator[tuple[int, Sums]]:
    """Per live epoch but the first, its place and the sums over the frames before it."""
    sums = _summaries(state)
    for place, epoch in enumerate(state.epochs[:-1]):
        sums = _after_epoch(state, sums + epoch.sums, epoch)
        before = sums
        for later in state.epochs[place + 1 : -1]:
            before = _after_epoch(state, before, later)
        yield place + 1, before


def split_halves(state: State) -> Sums:
    """(n, 2) sums over every other closed epoch; those of the open one are the next half's."""
    halves = Sums.stack([one.summary.halves for one in state.cameras])
    for age, epoch in enumerate(state.epochs[:-1]):
        halves = halves + in_its_half(state, epoch, age)
    return halves


def in_its_half(state: State, epoch: Epoch, age: int) -> Sums:
    """(n, 2) the sums of a live epoch, so many after the oldest, in the half that has it."""
    half = np.array([one.summary.next_half + age for one in state.cameras])
    weights: Array = np.eye(2)[half % 2]
    return epoch.sums[:, None] * weights


def estimates_of_halves(state: State, halves: Sums, camera: int) -> tuple[Array, Array] | None:
    """Two (4, 4) T_camera_lidar of a camera; None if one of them is undetermined."""
    first, second = (halves[camera].step(half) for half in range(2))
    if first is None or second is None:
        return None
    reference = state.references[camera]
    return to_T_camera_lidar(reference.retract(first)), to_T_camera_lidar(reference.retract(second))


def _summaries(state: State) -> Sums:
    return Sums.stack([one.summary.selected for one in state.cameras])


def _after_epoch(state: State, sums: Sums, epoch: Epoch) -> Sums:
    """The sums after the random walk of an epoch."""
    strengths = STRENGTHS[[one.summary.walk for one in state.cameras]]
    if not strengths.any():
        return sums
    variance = np.outer(strengths**2, state.walk_variance(len(epoch.frames)))
    overconfidence = [state.overconfidence(camera) for camera in range(len(strengths))]
    return sums.after_walk(variance, np.array(overconfidence))[0]


def _until(epoch: Epoch, number: int | None) -> Sums:
    if number is None:
        return epoch.sums
    earlier = [frame.sums for frame in epoch.frames if frame.number < number]
    return Sums.stack([Sums.zeros(len(epoch.T_lidar_camera)), *earlier]).total()
