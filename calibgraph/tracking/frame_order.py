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
    """

    frame: int
    table: Correspondences
    stamp_ns: int | None = None


def with_number(table: Correspondences, frame: int | None) -> StreamFrame:
    """The one frame that a table holds.

    Args:
        table: its correspondences.
        frame: its number, which an empty table does not have.

    Raises:
        CorrespondenceError: if the table holds several frames or another one, or a number has more
            than 63 bits.
    """
    numbers = {*np.unique(table.frame).tolist()}
    if len(numbers) > 1:
        raise CorrespondenceError(
            f"an update takes one frame, found {len(numbers)} (from {min(numbers)} to "
            f"{max(numbers)}); give them one by one"
        )
    if frame is None and not numbers:
        raise CorrespondenceError("the table is empty; name which frame it is: frame=...")
    number = index(min(numbers) if frame is None else frame)
    if not -(2**63) <= number < 2**63:
        raise CorrespondenceError(
            f"a frame's number must have at most 63 bits, found {number.bit_length()}; "
            "correct it: it is left out"
        )
    if numbers and number not in numbers:
        raise CorrespondenceError(f"the table is of frame {min(numbers)}, not {number}")
    return StreamFrame(number, table)


def prepared(state: State, frame: StreamFrame, last: int | None) -> StreamFrame:
    """A frame as an update takes it, with the metadata of a single frame.

    Args:
        state: of the frames before.
        frame: with all rows of one frame.
        last: number of the frame before.

    Raises:
        CorrespondenceError: if it does not come after the last one, or its metadata are wrong.
    """
    number = with_number(frame.table, frame.frame).frame
    if last is not None and number <= last:
        what = "comes again" if number == last else f"comes after frame {last}"
        raise CorrespondenceError(
            f"frame {number} {what}; frames must be in the order of their numbers: it is left out"
        )
    table = with_common_error(frame.table, state.config)
    if len(table):
        table = _with_motion_in_use(state.rig, table, state.knows_motion)
    stamp = frame.stamp_ns
    if stamp is None and len(table) and table.stamp_ns is not None:
        stamp = int(table.stamp_ns.max())
    return StreamFrame(number, with_metadata_per_frame(with_place(table, None)), stamp)


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


def with_place(table: Correspondences, place: str | int | None) -> Correspondences:
    """The table with the name of its place in the metadata, and without the lists of places.

    Args:
        table: the correspondences of one frame.
        place: None: its own by the metadata, or the first number of its list.

    Raises:
        CorrespondenceError: if it is no name, or the lists are wrong.
    """
    if place is None and not table.metadata:
        return table
    if place is None and PLACE not in table.metadata:
        place = table.places.name_of(int(table.frame[0])) if len(table) else ""
    name = _place_name(table.metadata[PLACE] if place is None else place)
    kept = {key: value for key, value in table.metadata.items() if key not in (PLACE, PLACES)}
    return _with_metadata(table, kept | ({PLACE: name} if name else {}))


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
    return _with_metadata(table, kept)


def _with_metadata(table: Correspondences, kept: dict[str, object]) -> Correspondences:
    return table if kept == table.metadata else table.with_metadata(kept)


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
