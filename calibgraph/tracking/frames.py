"""Frames of correspondences: of a table, or JSON lines; and what an update takes of them.

A line of JSON holds a frame::

    {"frame": 7, "cameras": {"left": {"u_px": [...], "v_px": [...],
                                      "x_m": [...], "y_m": [...], "z_m": [...]}}}

Optional in a camera: ``confidence``; ``i_uu_px``, ``i_uv_px`` and ``i_vv_px``.
Optional beside ``frame``: ``stamp_ns``; ``place``, where the vehicle is, a name or a number;
``twist_per_s``, the six columns ``wx_rad_s`` to ``vz_m_s`` of a table; and ``metadata``, as there.
"""

from __future__ import annotations

import os
import reprlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from operator import index
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import from_json

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, CorrespondenceError, FileError, MotionError
from calibgraph.files import decode_text, describe
from calibgraph.io.bags.storage import is_bag
from calibgraph.io.tables import load_correspondences
from calibgraph.model.clock import OF_IMAGES, OF_TABLES, unused_times
from calibgraph.model.correspondences import (
    COORDINATES,
    INFORMATION,
    TWISTS,
    Correspondences,
    as_confidence,
)
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.places import PLACES
from calibgraph.solver.preprocess import REPEATED_SHARE, with_common_error
from calibgraph.tracking.state import State

MAX_LINE_BYTES = 64 * 2**20
PLACE = "place"
"""Key of a frame's metadata: the name of the place that it is of."""

_LONGEST_PLACE = 200
_DATASET = "match its frames first, with `calibgraph match` or as in docs/tracking.md"
_FINDINGS_PER_FRAME = (
    "systematic_rotation_rad", "systematic_translation_m", "camera_share",
    "elevation_rad", "elevation_stretch", "scan_motion_m",
    "place_rotation_rad", "place_translation_m", "place_variance",
)  # fmt: skip

Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]


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


Item = StreamFrame | CalibrationError
"""A frame, or why there is none."""


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


def frames_of(source: Path | str) -> Iterator[Item]:
    """The frames of a table, or of "-": JSON lines on standard input.

    Raises:
        FileError: at once, if there is no such source or a row of the table is wrong; while it is
            read, if standard input is not text.
    """
    if str(source) == "-":
        if sys.stdin is None:
            raise FileError("standard input", "is closed; pipe frames in")
        return frames_of_lines(sys.stdin.buffer, "standard input")
    path = Path(source)
    if os.path.isdir(path) or (os.path.exists(path) and is_bag(path)):
        raise FileError(path, f"is no table of correspondences; {_DATASET}")
    return frames_of_table(load_correspondences(path))


def frames_of_table(table: Correspondences) -> Iterator[StreamFrame]:
    """The frames of a table, in ascending order."""
    order = np.argsort(table.frame, kind="stable")
    numbers, starts = np.unique(table.frame[order], return_index=True)
    for number, rows in zip(numbers.tolist(), np.split(order, starts[1:]), strict=True):
        yield StreamFrame(number, table.select(rows))


class CameraColumns(BaseModel):
    """One camera's correspondences as lists of one length; see the table of correspondences."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    u_px: list[float]
    v_px: list[float]
    x_m: list[float]
    y_m: list[float]
    z_m: list[float]
    confidence: list[float] = []
    i_uu_px: list[float] = []
    i_uv_px: list[float] = []
    i_vv_px: list[float] = []
    late_s: list[float] = []

    @model_validator(mode="after")
    def _require_whole_table(self) -> Self:
        given = self.model_fields_set
        partial = sorted(given.intersection(INFORMATION))
        if partial and len(partial) < len(INFORMATION):
            raise ValueError(f"has only {partial} of {list(INFORMATION)}; add all")
        lengths = {k: len(getattr(self, k)) for k in type(self).model_fields if k in given}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the lists differ in length: {lengths}")
        return self


class FrameLine(BaseModel):
    """One line: the correspondences of one frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    frame: Int64
    stamp_ns: Int64 | None = None
    cameras: dict[str, CameraColumns]
    place: str | Int64 | None = None
    twist_per_s: Annotated[list[float], Field(min_length=6, max_length=6)] | None = None
    metadata: dict[str, Any] = {}

    def to_frame(self) -> StreamFrame:
        """The frame with the correspondences of all its cameras.

        Raises:
            CorrespondenceError: if a value is out of its range.
        """
        cameras = [*self.cameras.values()]
        counts = [len(camera.u_px) for camera in cameras]
        n = sum(counts)

        def columns(**otherwise: float) -> Any:
            """(n, k); with a value for cameras that do not give one, None if none does."""
            if not any(getattr(one, key) for one in cameras for key in otherwise):
                return None
            rows = [
                [v for one in cameras for v in getattr(one, key) or [value] * len(one.u_px)]
                for key, value in otherwise.items()
            ]
            return np.array(rows, np.float64).T.copy()

        coordinates = columns(**dict.fromkeys(COORDINATES, np.nan))
        coordinates = np.zeros((0, 5)) if coordinates is None else coordinates
        confidence, late = columns(confidence=1.0), columns(late_s=0.0)
        table = Correspondences(
            cameras=tuple(self.cameras),
            camera_index=np.repeat(np.arange(len(cameras), dtype=np.int32), counts),
            frame=np.full(n, self.frame, np.int64),
            pixels_px=coordinates[:, :2].copy(),
            points_lidar_m=coordinates[:, 2:].copy(),
            confidence=as_confidence(np.ones(n) if confidence is None else confidence[:, 0]),
            information_px=columns(**dict(zip(INFORMATION, (1.0, 0.0, 1.0), strict=True))),
            stamp_ns=None if self.stamp_ns is None else np.full(n, self.stamp_ns),
            twist_per_s=np.tile(self.twist_per_s, (n, 1)) if self.twist_per_s and n else None,
            late_s=None if late is None else late[:, 0],
            metadata=self.metadata,
        )
        return StreamFrame(self.frame, table, self.stamp_ns, self.place)


def frames_of_lines(file: BinaryIO, where: str) -> Iterator[Item]:
    """The frames of JSON lines, each as soon as its line is complete; none is read ahead.

    Args:
        file: the lines.
        where: its name in messages.

    Raises:
        FileError: if it is not text, a line is too long or it cannot be read.
        MotionError: if a motion is that of no vehicle: slower frames would be wrong unseen.
    """
    number = 0
    while True:
        try:
            line = file.readline(MAX_LINE_BYTES + 1)
        except (OSError, ValueError) as error:
            raise FileError(where, f"cannot be read ({error}); restart") from error
        if not line:
            return
        number += 1
        place = f"{where}, line {number}"
        if len(line) > MAX_LINE_BYTES:
            raise FileError(place, f"is longer than {MAX_LINE_BYTES} bytes; send a frame a line")
        if number == 1 and "\0" in decode_text(line, where):
            raise FileError(where, "is not text; send a line of JSON per frame, in UTF-8")
        if line.strip():
            yield _parse(line.removeprefix(b"\xef\xbb\xbf"), place)


def _parse(line: bytes, where: str) -> Item:
    try:
        return FrameLine.model_validate(from_json(line, allow_inf_nan=False)).to_frame()
    except ValidationError as error:
        return FileError(where, describe(error))
    except MotionError as error:
        raise MotionError(f"{where}: {error.without_row}; correct that of all frames") from error
    except CorrespondenceError as error:
        return FileError(where, error.without_row)
    except ValueError as error:
        return FileError(where, f"is not JSON ({error}); send one frame a line, as JSON")


# What an update takes


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
        _require_same_motion(state, table)
        if stamp is None and table.stamp_ns is not None:
            stamp = int(table.stamp_ns.max())
    return StreamFrame(number, table, stamp, _place_of(frame))


def as_kept(frame: StreamFrame) -> StreamFrame:
    """The frame with no more metadata than an update uses."""
    table = frame.table
    if table.metadata:
        table = table.with_metadata(findings_of(table.findings).to_metadata())
    return StreamFrame(frame.frame, table, frame.stamp_ns, _place_of(frame))


def findings_of(stated: MatcherFindings) -> MatcherFindings:
    """Those findings of a matcher that are about the errors which frames share."""
    return MatcherFindings(**{key: getattr(stated, key) for key in _FINDINGS_PER_FRAME})


def _place_of(frame: StreamFrame) -> str:
    """The name of a frame's place: as given, by the metadata, or of the list that has it."""
    place, metadata = frame.place, frame.table.metadata
    if place is None and PLACE not in metadata:
        return frame.table.places.name_of(frame.frame) if PLACES in metadata else ""
    place = metadata[PLACE] if place is None else place
    if isinstance(place, bool) or not isinstance(place, (str, int, np.integer)):
        found = f"found {reprlib.repr(place)}"
        raise CorrespondenceError(f"the place of a frame must be a name or a number, {found}")
    name = str(place)
    if len(name) > _LONGEST_PLACE or any(c == "\0" or "\ud800" <= c <= "\udfff" for c in name):
        raise CorrespondenceError(
            f"the place of a frame must have at most {_LONGEST_PLACE} characters, no NUL and no "
            f"surrogate, found {reprlib.repr(name)}"
        )
    return name


def _require_same_motion(state: State, table: Correspondences) -> None:
    """Refuse a frame with the motion of the LiDAR, or times of points, where others have none."""
    found, before = table.motion_column, state.motion
    if before is not None and before != found:
        one, other = (name or "neither motion nor times of points" for name in (found, before))
        raise CorrespondenceError(
            f"it has {one}, earlier frames have {other}; error bars need the same of every frame: "
            f"give {before or found} with all, or with none"
        )
    if before is None:
        unused_times(state.rig, is_known=found == TWISTS, how=f"{OF_IMAGES}, {OF_TABLES}")


def repeated_cameras(state: State, table: Correspondences) -> list[int]:
    """Numbers of the table's cameras most of whose last points are in it again, to the last bit."""
    x_m, found = {*table.points_lidar_m[:, 0].tolist()}, list[int]()
    for camera, name in enumerate(state.names):
        last = _last_points(state, camera)
        if last is None or name not in table.cameras or x_m.isdisjoint(last[:, 0].tolist()):
            continue
        number = table.cameras.index(name)
        points = {*map(tuple, table.points_lidar_m[table.camera_index == number].tolist())}
        again = sum(tuple(point) in points for point in last.tolist())
        if again > REPEATED_SHARE * len(last):
            found.append(number)
    return found


def _last_points(state: State, camera: int) -> Array | None:
    """(n, 3) of the last frame, absorbed or, before the camera has started, waiting."""
    if waiting := state.waiting[camera]:
        return waiting[-1].of_camera(state.names[camera]).points_lidar_m
    if not state.matches[camera]:
        return None
    last = state.matches[camera][-1].raw
    return last.block.points_lidar_m[last.frame_edges[-2] :]
