"""What an update takes: a frame after the last one, and what holds for it alone."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import index

import numpy as np

from calibgraph.errors import CorrespondenceError
from calibgraph.model.clock import OF_IMAGES, OF_TABLES, unused_times
from calibgraph.model.correspondences import Correspondences
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

_LAST = 2**63 - 1  # other programs write it for "none"
_MOST_SKIPPED = {"number": 10**12, "stamp_ns": 2**62}
"""Between two frames. Numbers that are nanoseconds pause for 17 min; a clock may be set once."""
_SKIPPED_SHARE = 1000
"""A larger number may skip this part of it: three weeks, if it is a time since 1970."""
LONGEST_PLACE = 200
_FINDINGS_PER_FRAME = (
    "systematic_rotation_rad", "systematic_translation_m", "camera_share",
    "elevation_rad", "elevation_stretch", "scan_motion_m",
    "place_rotation_rad", "place_translation_m", "place_variance",
)  # fmt: skip

PLACE = "place"
"""Key of a frame's metadata: the name of the place that it is of."""


@dataclass(frozen=True, eq=False)
class Incoming:
    """A frame that comes after the last one.

    Attributes:
        number: of the frame.
        stamp_ns: its time, or that of the last frame that had one, or None.
        table: its correspondences, with the metadata of a single frame.
    """

    number: int
    stamp_ns: int | None
    table: Correspondences


def incoming(
    state: State,
    table: Correspondences,
    frame: int | None,
    last: tuple[int | None, int | None] | None = None,
) -> Incoming:
    """A frame that an update can take.

    Args:
        state: of the frames before.
        table: the correspondences of one frame.
        frame: its number, which an empty table does not have.
        last: number and time of the frame before; None: that of the state.

    Raises:
        CorrespondenceError: if it is none.
    """
    table = with_common_error(table, state.config)
    if len(table):
        table = _with_motion_in_use(state.rig, table, state.knows_motion)
    table = with_metadata_per_frame(with_place(table, None))
    last = (state.frame, state.stamp_ns) if last is None else last
    number, stamp = number_and_stamp(table, frame, last)
    return Incoming(number, last[1] if stamp is None else stamp, table)


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


def number_and_stamp(
    table: Correspondences, frame: int | None, last: tuple[int | None, int | None]
) -> tuple[int, int | None]:
    """The number and the time stamp [ns] of the frame that a table holds.

    Args:
        table: the correspondences of one frame.
        frame: its number, which an empty table does not have.
        last: those of the frame before.

    Raises:
        CorrespondenceError: if the table holds several frames, or one that is not after the last,
            or the number is beyond 63 bits.
    """
    require_number(frame)
    same = len(table) > 0 and (table.frame == table.frame[0]).all()
    numbers = table.frame[:1] if same else np.unique(table.frame)
    if len(numbers) > 1:
        raise CorrespondenceError(
            f"an update takes one frame, found {len(numbers)} (from {numbers[0]} to "
            f"{numbers[-1]}); give them one by one"
        )
    if frame is None and not len(numbers):
        raise CorrespondenceError("the table is empty; name which frame it is: frame=...")
    number = int(numbers[0]) if len(numbers) else int(frame or 0)
    if frame is not None and number != frame:
        raise CorrespondenceError(f"the table is of frame {number}, not {frame}", frame=number)
    stamp = int(table.stamp_ns.max()) if table.stamp_ns is not None and len(table) else None
    _require_after(last, number, stamp)
    return number, stamp


def require_number(frame: int | None) -> None:
    """Refuse a number that no table can hold.

    Raises:
        CorrespondenceError: if it is beyond 63 bits.
    """
    if frame is not None and not -_LAST - 1 <= frame <= _LAST:
        raise CorrespondenceError(
            f"a frame's number must have at most 63 bits, found {index(frame).bit_length()}; "
            "correct it: it is left out"
        )


def _require_after(last: tuple[int | None, int | None], number: int, stamp: int | None) -> None:
    for what, value in (("number", number), ("stamp_ns", stamp)):
        if value == _LAST:
            raise CorrespondenceError(
                f"frame {number}: its {what} {value} is the largest there is, and no frame could "
                "follow; correct it: it is left out",
                frame=number,
            )
    last_number, last_stamp = last
    if last_number is not None and number <= last_number:
        what = "comes again" if number == last_number else f"comes after frame {last_number}"
        raise CorrespondenceError(
            f"frame {number} {what}; frames must be in the order of their numbers: it is left out",
            frame=number,
        )
    for what, value, before in (("number", number, last_number), ("stamp_ns", stamp, last_stamp)):
        if value is None or before is None:
            continue
        if value - before > max(_MOST_SKIPPED[what], abs(before) // _SKIPPED_SHARE):
            raise CorrespondenceError(
                f"frame {number}: its {what} {value} is far beyond {before} of the frame before, "
                "and the frames between would be too late; correct it: it is left out",
                frame=number,
            )
    if stamp is not None and last_stamp is not None and stamp <= last_stamp:
        raise CorrespondenceError(
            f"frame {number}: its stamp_ns {stamp} is not after {last_stamp} of the frame "
            "before; correct the clock: it is left out",
            frame=number,
        )


def with_place(table: Correspondences, place: str | int | None) -> Correspondences:
    """The table with the name of its place in the metadata, and without the lists of places.

    Args:
        table: the correspondences of one frame.
        place: None: as by the metadata.

    Raises:
        CorrespondenceError: if it is no name, or the lists are wrong.
    """
    if place is None and not table.metadata:
        return table
    name = place_of(table) if place is None else _place_name(place)
    kept = {key: value for key, value in table.metadata.items() if key not in (PLACE, PLACES)}
    kept |= {PLACE: name} if name else {}
    return table if kept == table.metadata else replace(table, metadata=kept)


def with_metadata_per_frame(table: Correspondences) -> Correspondences:
    """The table with only that metadata which holds for a single frame.

    These are the findings of its matcher about shared errors, and the name of its place.

    Args:
        table: after :func:`with_place`.

    Raises:
        CorrespondenceError: if a finding is wrong.
    """
    if not table.metadata:
        return table
    findings = table.findings.to_metadata()
    kept = {key: findings[key] for key in _FINDINGS_PER_FRAME if key in findings}
    kept |= {key: table.metadata[key] for key in (PLACE,) if key in table.metadata}
    return table if kept == table.metadata else replace(table, metadata=kept)


def place_of(table: Correspondences) -> str:
    """The name of a frame's place: its own, or the first number of its list; empty if unknown."""
    if PLACE in table.metadata:
        return _place_name(table.metadata[PLACE])
    if not len(table):
        return ""
    number = int(table.frame[0])
    return table.places.name_of(number)


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
    hashes, repeated = point_hashes(table.points_lidar_m), list[int]()
    for camera, name in enumerate(state.names):
        number = table.cameras.index(name) if name in table.cameras else -1
        if _repeats(_last_hashes(state, camera), hashes[table.camera_index == number]):
            repeated.append(number)
    return table.select(~np.isin(table.camera_index, repeated)) if repeated else table


def share_last_points(state: State, tables: Sequence[Correspondences]) -> bool:
    """Whether any table has a point of a camera's last frame; else none can repeat it."""
    hashes = {*hash_numbers(np.concatenate([table.points_lidar_m for table in tables]))}
    lasts = (_last_hashes(state, camera) for camera in range(len(state.names)))
    return not all(hashes.isdisjoint(last or ()) for last in lasts)


def _repeats(last: list[int] | None, hashes: Hashes) -> bool:
    """Whether a camera's points are those of the last frame that it has any of."""
    if last is None or not len(hashes):
        return False
    return sum(map({*hashes.tolist()}.__contains__, last)) > REPEATED_SHARE * len(last)


def _last_hashes(state: State, camera: int) -> list[int] | None:
    """Of the last frame's matches, absorbed ones or, before the camera has started, waiting."""
    if waiting := state.waiting[camera]:
        return hash_numbers(waiting[-1].of_camera(state.names[camera]).points_lidar_m)
    if not state.blocks[camera]:
        return None
    last = state.blocks[camera][-1]
    if last.frames == 1:
        return last.point_hashes
    return hash_numbers(last.block.points_lidar_m[last.frame_edges[-2] :])
