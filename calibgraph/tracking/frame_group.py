"""Frames that come together: those at the front that show nothing unusual are taken in at once.

Each is gated by itself, at the minimum of all; there is one solve and one assessment. Whatever may
be more than a frame to absorb is left to the update of a single frame: a camera that starts, a
frame that disagrees with the estimate or repeats another one, an error.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import takewhile
from typing import Protocol

import numpy as np

from calibgraph.errors import CorrespondenceError
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.solver.matches import MIN_MATCHES, CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.assessment import rig_at
from calibgraph.tracking.frame_order import (
    Incoming,
    incoming,
    share_last_points,
    without_repeats,
)
from calibgraph.tracking.outlier_frames import agreeing_frames
from calibgraph.tracking.state import State
from calibgraph.tracking.step_detection import may_have_moved
from calibgraph.tracking.stream_tables import Item, Refused, StreamFrame
from calibgraph.tracking.update import Update

Blocks = dict[int, CameraBlock]


class Calibrator(Protocol):
    """A tracker in memory or on disk."""

    def update(self, table: Correspondences, *, frame: int | None = None) -> Update:
        """Take in one frame."""

    def update_together(self, frames: Sequence[StreamFrame]) -> list[Update]:
        """Take in the first frames that show nothing unusual."""


def update_all(
    calibrator: Calibrator, frames: Sequence[StreamFrame]
) -> Iterator[list[Update] | Refused]:
    """Take in frames, together where nothing is unusual; what became of them, in their order.

    Args:
        calibrator: takes them in.
        frames: in the order of their numbers.

    Returns:
        Updates, or why one frame is left out.
    """
    taken = 0
    while taken < len(frames):
        updates = calibrator.update_together(frames[taken:])
        if not updates:
            one = frames[taken]
            try:
                updates = [calibrator.update(one.table, frame=one.frame)]
            except CorrespondenceError as error:
                taken += 1
                yield Refused(one.why_not(error))
                continue
        taken += len(updates)
        yield updates


def in_groups(items: Iterable[Item], most: int) -> Iterator[list[StreamFrame] | Refused]:
    """Frames in the order of their numbers, at most so many at once; what is none, by itself."""
    held = list[StreamFrame]()
    for item in items:
        follows = isinstance(item, StreamFrame) and (not held or item.frame > held[-1].frame)
        if held and not follows:
            yield held
            held = []
        if isinstance(item, Refused):
            yield item
            continue
        held.append(item)
        if len(held) >= most:
            yield held
            held = []
    if held:
        yield held


def usual_frames(state: State, frames: Sequence[StreamFrame]) -> tuple[list[Incoming], Blocks]:
    """The first frames that can be taken in at once, none if that is fewer than two.

    Args:
        state: of the tracker.
        frames: in their order.

    Returns:
        The frames; per camera the preprocessed matches of all.
    """
    if len(frames) < 2 or may_have_moved(state):  # noqa: PLR2004
        return [], {}
    group = _alike(state, frames)
    if len(group) < 2:  # noqa: PLR2004
        return [], {}
    blocks = _blocks(state, group)
    if blocks is None:
        return [], {}
    numbers = [one.number for one in group]
    end = min([len(group), *(_first_unusual(state, *each, numbers) for each in blocks.items())])
    if end < 2:  # noqa: PLR2004
        return [], {}
    if end < len(group):
        limit = group[end].number
        blocks = {c: block.select(block.frame < limit) for c, block in blocks.items()}
    return group[:end], {camera: block for camera, block in blocks.items() if len(block)}


def _alike(state: State, frames: Sequence[StreamFrame]) -> list[Incoming]:
    """The first frames, up to the end of the epoch, that state the same of their errors.

    No more than an epoch's frames are not divided: the epoch is longer then, and the next ones that
    come so fill one each. None repeats a frame of before: a camera may have its first matches in
    any of them.
    """
    group, room = list[Incoming](), state.config.tracking.epoch_frames
    room -= len(state.epochs[-1].frames) if len(frames) > room else 0
    last = state.frame, state.stamp_ns
    for frame, _ in zip(frames, range(room), strict=False):
        try:
            one = incoming(state, frame.table, frame.frame, last)
        except CorrespondenceError:
            break
        known = {*one.table.cameras} <= {*state.names}
        if not known or (group and _columns(group[0].table) != _columns(one.table)):
            break
        group.append(one)
        last = one.number, one.stamp_ns
    if not group or not share_last_points(state, [one.table for one in group]):
        return group
    return [*takewhile(lambda one: without_repeats(state, one.table) is one.table, group)]


def _columns(table: Correspondences) -> tuple[object, ...]:
    optional = table.information_px, table.twist_per_s
    return len(table) > 0, table.findings, *(column is None for column in optional)


def _blocks(state: State, group: Sequence[Incoming]) -> Blocks | None:
    """The preprocessed matches, as of single frames; None if one repeats another one."""
    table = concatenate([one.table for one in group])
    kept = preprocess(rig_at(state, state.T_lidar_camera), table, state.config)
    if any(kept.repeated_frames.values()):
        return None
    blocks = camera_blocks(state.rig, kept.table, state.config)
    found = {state.names.index(name): _with_enough(block) for name, block in blocks.items()}
    return {camera: block for camera, block in found.items() if len(block)}


def _with_enough(block: CameraBlock) -> CameraBlock:
    enough = block.frame_counts >= MIN_MATCHES
    return block if enough.all() else block.select(np.repeat(enough, block.frame_counts))


def _first_unusual(state: State, camera: int, block: CameraBlock, numbers: Sequence[int]) -> int:
    """Row of the first frame that disagrees with a camera's estimate; beyond the last if none."""
    one, own = state.cameras[camera], block.frame_numbers
    if one.started:
        own = own[~agreeing_frames(block, state.T_lidar_camera[camera], one)]
    return numbers.index(int(own[0])) if len(own) else len(numbers)
