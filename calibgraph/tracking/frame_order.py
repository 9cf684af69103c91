"""What an update takes: a frame after the last one, and what holds for it alone."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, replace
from operator import index

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.model.clock import OF_IMAGES, OF_TABLES, unused_times
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.places import PLACES
from calibgraph.model.rig import Rig
from calibgraph.solver.preprocess import (
    REPEATED_SHARE,
    Hashes,
    hash_numbers,
    point_hashes,
    with_common_error,
)
from calibgraph.tracking.state import State

LONGEST_PLACE = 200
_FINDINGS_PER_FRAME = (
    "systematic_rotation_rad", "systematic_translation_m", "camera_share",
    "elevation_rad", "elevation_stretch", "scan_motion_m",
    "place_rotation_rad", "place_translation_m", "place_variance",
)  # fmt: skip

PLACE = "place"
"""Key of a frame's metadata: the name of the place that it is of."""


@dataclass(frozen=True)
class StreamFrame:
    """The correspondences of one frame, all its cameras.

    Attributes:
        frame: its number.
        table: rows of this frame alone; there may be none.
        stamp_ns: its time; None: as the table has it.
        place: the name of its place; None: as the table's metadata have it.
    """

    frame: int
    table: Correspondences
    stamp_ns: int | None = None
    place: str | int | None = None


def frame_of(
    table: Correspondences, frame: int | None = None, place: str | int | None = None
) -> StreamFrame:
    """The one frame that a table holds.

    Args:
        table: its correspondences.
        frame: its number, which an empty table does not have.
        place: where it is; None: as the metadata have it.

    Raises:
        CorrespondenceError: if the table is empty, and no number given.
    """
    if frame is None and not len(table):
        raise CorrespondenceError("the table is empty; name which frame it is: frame=...")
    return StreamFrame(int(table.frame[0]) if frame is None else index(frame), table, None, place)


def prepared(state: State, frame: StreamFrame, last: int | None) -> StreamFrame:
    """A frame as an update takes it, its time and place known.

    Args:
        state: of the frames before.
        frame: with all rows of one frame.
        last: number of the frame before.

    Raises:
        CorrespondenceError: if it does not come after the last one, its table is of others or
            several, its number has more than 63 bits, or its place or metadata are wrong.
    """
    number, stamp = frame.frame, frame.stamp_ns
    if not -(2**63) <= number < 2**63:
        raise CorrespondenceError(
            f"a frame's number must have at most 63 bits, found {number.bit_length()}; "
            "correct it: it is left out"
        )
    if not (frame.table.frame == number).all():
        found = f"found rows of {np.unique(frame.table.frame)[:3].tolist()} for {number}"
        raise CorrespondenceError(f"an update takes one frame, {found}; give them one by one")
    if last is not None and number <= last:
        what = "comes again" if number == last else f"comes after frame {last}"
        raise CorrespondenceError(
            f"frame {number} {what}; frames must be in the order of their numbers: it is left out"
        )
    table = with_common_error(frame.table, state.config)
    if len(table):
        table = _with_motion_in_use(state.rig, table, state.knows_motion)
        if stamp is None and table.stamp_ns is not None:
            stamp = int(table.stamp_ns.max())
    return StreamFrame(number, table, stamp, _place_of(frame))


def _place_of(frame: StreamFrame) -> str:
    """The name of a frame's place: as given, by the metadata, or of the list that has it."""
    metadata = frame.table.metadata
    if frame.place is not None or PLACE in metadata:
        return _place_name(metadata[PLACE] if frame.place is None else frame.place)
    return frame.table.places.name_of(frame.frame) if PLACES in metadata else ""


def findings_of(stated: MatcherFindings) -> MatcherFindings:
    """Those findings of a matcher that are about the errors which frames share."""
    return MatcherFindings(**{key: getattr(stated, key) for key in _FINDINGS_PER_FRAME})


def as_kept(frame: StreamFrame) -> StreamFrame:
    """The frame with no more metadata than an update uses."""
    table = frame.table.with_metadata(findings_of(frame.table.findings).to_metadata())
    return StreamFrame(frame.frame, table, frame.stamp_ns, _place_of(frame))


def unsolvable(number: int, error: BaseException) -> CorrespondenceError:
    """Why a frame is left out whose estimate cannot be solved for."""
    return CorrespondenceError(
        f"frame {number}: with its matches the estimate cannot be solved for "
        f"({str(error).strip().splitlines()[0]}); it is left out",
        frame=number,
    )


def _with_motion_in_use(rig: Rig, table: Correspondences, before: bool | None) -> Correspondences:
    """The matches of a frame, with the motion of the LiDAR where a clock uses it.

    Args:
        rig: with the clocks of its cameras.
        table: the matches.
        before: whether that of earlier frames is known; None if there are none.

    Raises:
        CorrespondenceError: if it is known of some frames alone.
    """
    known = table.twist_per_s is not None
    used = any(c.time_offset_s or c.readout_s for c in rig.cameras.values())
    if not used:
        return replace(table, twist_per_s=None) if known else table
    if before is not None and before != known:
        found, earlier = ("no ", "one") if not known else ("a ", "none")
        raise CorrespondenceError(
            f"it has {found}motion of the LiDAR (twist_per_s), earlier frames have {earlier}; the "
            "rig's time_offset_s and readout_s need it with every frame: give it or leave it out"
        )
    if before is None:
        unused_times(rig, is_known=known, how=f"{OF_IMAGES}, {OF_TABLES}")
    return table


def _place_name(place: object) -> str:
    """A name as text."""
    if isinstance(place, bool) or not isinstance(place, (str, int, np.integer)):
        found = f"found {reprlib.repr(place)}"
        raise CorrespondenceError(f"the place of a frame must be a name or a number, {found}")
    name = str(place)
    if len(name) > LONGEST_PLACE or any(c == "\0" or "\ud800" <= c <= "\udfff" for c in name):
        raise CorrespondenceError(
            f"the place of a frame must have at most {LONGEST_PLACE} characters, no NUL and no "
            f"surrogate, found {reprlib.repr(name)}"
        )
    return name


def without_repeats(state: State, table: Correspondences) -> Correspondences:
    """The table without cameras most of whose last points are in it again, to the last bit.

    Args:
        state: before the frame.
        table: of the frame.
    """
    if not share_last_points(state, table):
        return table
    hashes, repeated = point_hashes(table.points_lidar_m), list[int]()
    for camera, name in enumerate(state.names):
        number = table.cameras.index(name) if name in table.cameras else -1
        last = _last_points(state, camera)
        if last is not None and _repeats(last, hashes[table.camera_index == number]):
            repeated.append(number)
    return table.select(~np.isin(table.camera_index, repeated)) if repeated else table


def share_last_points(state: State, table: Correspondences) -> bool:
    """Whether a table may have a point of a camera's last frame; else none can repeat it."""
    x_m = {*table.points_lidar_m[:, 0].tolist()}
    lasts = (_last_points(state, camera) for camera in range(len(state.names)))
    return not all(last is None or x_m.isdisjoint(last[:, 0].tolist()) for last in lasts)


def _repeats(last: Array, hashes: Hashes) -> bool:
    """Whether a camera's points are those of the last frame that it has any of."""
    numbers = hash_numbers(last)
    found = sum(map({*hashes.tolist()}.__contains__, numbers))
    return len(hashes) > 0 and found > REPEATED_SHARE * len(numbers)


def _last_points(state: State, camera: int) -> Array | None:
    """(n, 3) of the last frame, absorbed or, before the camera has started, waiting."""
    if waiting := state.waiting[camera]:
        return waiting[-1].of_camera(state.names[camera]).points_lidar_m
    if not state.blocks[camera]:
        return None
    last = state.blocks[camera][-1]
    return last.block.points_lidar_m[last.frame_edges[-2] :]
