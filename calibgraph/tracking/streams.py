"""Frames of correspondences, one at a time: from a table, or JSON lines on standard input.

Every source is pulled: nothing is read ahead of its use beyond one chunk, so that a slow reader
slows the writer down and an endless stream needs the memory of one frame.

A line of JSON holds a frame::

    {"frame": 7, "cameras": {"left": {"u_px": [...], "v_px": [...],
                                      "x_m": [...], "y_m": [...], "z_m": [...]}}}

Optional in a camera: ``confidence``; ``i_uu_px``, ``i_uv_px`` and ``i_vv_px``; ``point_index``.
Optional beside ``frame``: ``stamp_ns``; ``place``, where the vehicle is, a name or a number;
``twist_per_s``, the six columns ``wx_rad_s`` to ``vz_m_s`` of a table; and ``metadata``, as there.
A line with ``metadata`` alone is a header, and holds for the lines after it, as here for the error
that all frames share::

    {"metadata": {"systematic_rotation_rad": 0.001, "systematic_translation_m": 0.01}}
"""

from __future__ import annotations

import select
import stat
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO, Protocol, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import from_json

from calibgraph.errors import CorrespondenceError, FileError, MotionError
from calibgraph.files import describe, require_file
from calibgraph.io.bags.storage import is_bag
from calibgraph.io.tables import arrow_reads, from_arrow, open_parquet, read_arrow, require_rows
from calibgraph.model.correspondences import (
    COORDINATES,
    INFORMATION,
    TWIST,
    TWIST_RULE,
    Correspondences,
    as_confidence,
    beyond_vehicles,
    check_schema,
)
from calibgraph.model.findings import MatcherFindings
from calibgraph.tracking.assessment import Update
from calibgraph.tracking.frame_order import LONGEST_PLACE, with_place

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True)
class StreamFrame:
    """The correspondences of one frame, all its cameras.

    Attributes:
        frame: its number.
        table: rows of this frame alone; there may be none.
        where: the part of its source that it is from, for messages.
    """

    frame: int
    table: Correspondences
    where: str = ""

    def why_not(self, error: CorrespondenceError) -> str:
        """The message of an error of this frame, with where the frame is from."""
        return f"{self.where}: {error}" if self.where else str(error)


@dataclass(frozen=True)
class Refused:
    """Input that is not a frame.

    Attributes:
        message: of one line.
        by_motion: whether it is a frame with a motion that no vehicle has.
    """

    message: str
    by_motion: bool = False


Item = StreamFrame | Refused


def refused(where: Path | str, what: str, *, by_motion: bool = False) -> Refused:
    """The message for wrong input: where it is, and what is wrong."""
    return Refused(str(FileError(where, what)), by_motion)


def frames_of_table(path: Path) -> Iterator[Item]:
    """The frames of one Parquet or CSV file, in ascending order.

    Of a Parquet file whose row groups are in the order of their frames, one row group is in memory
    at a time; any other file is read whole.

    Raises:
        FileError: wherever the file turns out not to be readable.
    """
    for table in _parts_of_file(require_file(path)):
        yield from frames_in_table(table, str(path))


def require_plausible_motion(path: Path) -> None:
    """Check the motion in all rows of a table: its slower frames look right where it is wrong.

    What else is wrong, or cannot be read, is reported where its frame comes.

    Raises:
        FileError: with the first row of a motion that no vehicle has.
    """
    rows = 0
    for part in _motion_parts(path):
        twist = np.stack([part[name].to_numpy().astype(np.float64) for name in TWIST], axis=1)
        beyond = np.flatnonzero(beyond_vehicles(twist))
        if len(beyond):
            row = int(beyond[0])
            camera, frame = part["camera"][row].as_py(), part["frame"][row].as_py()
            rule = f"twist must {TWIST_RULE}, found {twist[row].tolist()}"
            text = f"{rule}; correct the columns {TWIST[0]} to {TWIST[-1]}"
            error = MotionError(text, camera=camera, frame=frame, row=rows + row)
            raise FileError(path, str(error))
        rows += len(part)


def _motion_parts(path: Path) -> Iterator[pa.Table]:
    """The columns of the motion, where a file has them, as far as they can be read."""
    columns = ["camera", "frame", *TWIST]
    with suppress(FileError, CorrespondenceError), arrow_reads(path):
        if path.suffix == ".csv":
            table = read_arrow(path)
            check_schema(table.schema)
            yield from [table] if TWIST[0] in table.column_names else []
            return
        with open_parquet(path) as file:
            check_schema(file.schema_arrow)
            if TWIST[0] in file.schema_arrow.names:
                for group in range(file.metadata.num_row_groups):
                    yield file.read_row_group(group, columns=columns)


def _parts_of_file(path: Path) -> Iterator[pa.Table]:
    """Tables of whole frames, those of later ones ascending, that make up a file."""
    if path.suffix == ".csv":
        table = read_arrow(path)
        require_rows(path, len(table))
        require_schema(path, table.schema)
        yield table
        return
    with arrow_reads(path), open_parquet(path) as file:
        require_rows(path, file.metadata.num_rows)
        require_schema(path, file.schema_arrow)
        spans = _frame_spans(file)
        yield from [file.read()] if spans is None else _row_groups(file, spans)


def _frame_spans(file: Any) -> list[tuple[int, int]] | None:
    """First and last frame of each row group, if they are in order.

    They are read from the column, not from its statistics: not every file has them, and of a
    damaged file Arrow cannot read them without ending the process.
    """
    spans: list[tuple[int, int]] = []
    for group in range(file.metadata.num_row_groups):
        frames = file.read_row_group(group, columns=["frame"])["frame"].drop_null().to_numpy()
        if not len(frames) or (spans and frames.min() < spans[-1][1]):
            return None
        spans.append((int(frames.min()), int(frames.max())))
    return spans


def _row_groups(file: Any, spans: Sequence[tuple[int, int]]) -> Iterator[pa.Table]:
    """One row group at a time; a frame that continues in the next one is held until it ends."""
    import pyarrow as pa

    held: list[pa.Table] = []
    for group, (_, last) in enumerate(spans):
        table = pa.concat_tables([*held, file.read_row_group(group)])
        held = []
        if group + 1 < len(spans) and spans[group + 1][0] == last:
            continues = table["frame"].to_numpy() == last
            held = [table.filter(pa.array(continues))]
            table = table.filter(pa.array(~continues))
        yield table


def require_schema(where: Path | str, schema: pa.Schema) -> None:
    """Check the columns' names and types, and the metadata.

    Raises:
        FileError: with the first thing that is wrong.
    """
    try:
        check_schema(schema)
        from_arrow(schema.empty_table())
    except CorrespondenceError as error:
        raise FileError(where, str(error)) from error


def frames_in_table(table: pa.Table, where: str) -> Iterator[Item]:
    """The frames of a table with a checked schema, in ascending order."""
    if table["frame"].null_count:
        count = table["frame"].null_count
        yield refused(where, f"column 'frame' is empty in {count} rows; fill in or drop them")
        table = table.filter(table["frame"].is_valid())
    for rows in _split_by_frame(table):
        yield _frame_or_refused(rows, where)


def _split_by_frame(table: pa.Table) -> Iterator[pa.Table]:
    if not len(table):
        return
    frames = table["frame"].to_numpy()
    order = np.argsort(frames, kind="stable")
    frames = frames[order]
    starts = np.concatenate([[0], np.flatnonzero(frames[1:] != frames[:-1]) + 1])
    lengths = np.diff(starts, append=len(frames))
    if (order[1:] < order[:-1]).any():
        table = table.take(order)
    for start, length in zip(starts, lengths, strict=True):
        yield table.slice(start, length)


def _frame_or_refused(rows: pa.Table, where: str) -> Item:
    """One frame from all its rows."""
    number = rows["frame"][0].as_py()
    try:
        return StreamFrame(number, from_arrow(rows), f"{where}, frame {number}")
    except CorrespondenceError as error:
        found = f"frame {number} is left out; among its rows, {error}"
        return refused(where, found, by_motion=isinstance(error, MotionError))


MAX_CAMERAS = 1000
MAX_LINE_BYTES = 64 * 2**20


Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Twist = Annotated[list[float], Field(min_length=6, max_length=6)]
PlaceName = Annotated[str, Field(max_length=LONGEST_PLACE)] | Int64


class CameraColumns(BaseModel):
    """One camera's correspondences as lists of one length; see the table of correspondences."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    u_px: list[float]
    v_px: list[float]
    x_m: list[float]
    y_m: list[float]
    z_m: list[float]
    confidence: list[float] = Field(default_factory=list)
    i_uu_px: list[float] = Field(default_factory=list)
    i_uv_px: list[float] = Field(default_factory=list)
    i_vv_px: list[float] = Field(default_factory=list)
    point_index: list[Int64] = Field(default_factory=list)

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

    def column(self, key: str, missing: float) -> list[float]:
        """A column; of one value, where it is not given."""
        given: list[float] = getattr(self, key)
        return given if key in self.model_fields_set else [missing] * len(self.u_px)


class HeaderLine(BaseModel):
    """A line that holds for those after it."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    metadata: dict[str, Any]


class FrameLine(BaseModel):
    """One line: the correspondences of one frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    frame: Int64
    stamp_ns: Int64 = 0
    cameras: Annotated[dict[str, CameraColumns], Field(max_length=MAX_CAMERAS)]
    place: PlaceName | None = None
    twist_per_s: Twist | None = None
    metadata: dict[str, Any] = Field(default_factory=dict)

    def to_frame(self, header: Mapping[str, Any]) -> StreamFrame:
        """The frame with the correspondences of all its cameras.

        Args:
            header: metadata of all frames, which its own replaces key by key.

        Raises:
            CorrespondenceError: if a value is out of its range.
        """
        counts = [len(camera.u_px) for camera in self.cameras.values()]
        n, names, twist = sum(counts), tuple(sorted(self.cameras)), self.twist_per_s
        stamped = n > 0 and "stamp_ns" in self.model_fields_set
        coordinates = self._columns(COORDINATES, [np.nan] * len(COORDINATES))
        sure, indexed = not self._has("confidence"), n > 0 and self._has("point_index")
        table = Correspondences(
            cameras=names,
            camera_index=np.repeat(np.array([*map(names.index, self.cameras)], np.int32), counts),
            frame=np.full(n, self.frame, np.int64),
            pixels_px=coordinates[:, :2].copy(),
            points_lidar_m=coordinates[:, 2:].copy(),
            confidence=as_confidence(
                np.ones(n) if sure else self._columns(["confidence"], [1])[:, 0]
            ),
            information_px=self._columns(INFORMATION, [1, 0, 1])
            if self._has(INFORMATION[0])
            else None,
            stamp_ns=np.full(n, self.stamp_ns, np.int64) if stamped else None,
            point_index=self._columns(["point_index"], [-1], np.int64)[:, 0] if indexed else None,
            twist_per_s=np.tile(twist, (n, 1)) if n and twist is not None else None,
            metadata={**header, **self.metadata},
        )
        return StreamFrame(self.frame, with_place(table, self.place))

    def _has(self, key: str) -> bool:
        """Whether a camera gives a column."""
        return any(key in camera.model_fields_set for camera in self.cameras.values())

    def _columns(self, keys: Sequence[str], missing: Sequence[float], kind: type = float) -> Any:
        """(n, k) columns of all cameras, with a value of each for those that do not give it."""
        cameras, every = self.cameras.values(), zip(keys, missing, strict=True)
        rows = [[*chain(*(camera.column(*column) for camera in cameras))] for column in every]
        return np.array(rows, kind).T.copy()


def frames_of_lines(chunks: Iterable[bytes], where: str) -> Iterator[Item]:
    """The frames of JSON lines, each as soon as its line is complete.

    Args:
        chunks: the bytes, cut anywhere.
        where: the name of their source in messages.
    """
    header: dict[str, Any] = {}
    for number, line in enumerate(_lines(chunks), start=1):
        place = f"{where}, line {number}"
        if line is None:
            found = f"is longer than {MAX_LINE_BYTES} bytes"
            yield refused(place, f"{found}; send one frame a line, or fewer correspondences")
        elif line.strip():
            parsed = _parse(line.removeprefix(b"\xef\xbb\xbf"), place, header)
            if isinstance(parsed, dict):
                header = parsed
            else:
                yield parsed


def _lines(chunks: Iterable[bytes]) -> Iterator[bytes | None]:
    """Lines without their ends; None, at once, for one that is too long: its rest is skipped."""
    kept, too_long = bytearray(), False
    for chunk in chunks:
        *ends, rest = chunk.split(b"\n")
        for end in ends:
            kept += end
            if not too_long:
                yield bytes(kept) if len(kept) <= MAX_LINE_BYTES else None
            kept, too_long = bytearray(), False
        kept += rest
        if len(kept) > MAX_LINE_BYTES:
            if not too_long:
                yield None
            kept, too_long = bytearray(), True
    if kept and not too_long:
        yield bytes(kept)


def _parse(line: bytes, where: str, header: Mapping[str, Any]) -> Item | dict[str, Any]:
    """A frame, why it is none, or the metadata of a header."""
    try:
        content = from_json(line, allow_inf_nan=False)
        if isinstance(content, dict) and content.keys() == {"metadata"}:
            metadata = HeaderLine.model_validate(content).metadata
            MatcherFindings.from_metadata(metadata)
            return metadata
        return replace(FrameLine.model_validate(content).to_frame(header), where=where)
    except ValidationError as error:
        return refused(where, describe(error))
    except CorrespondenceError as error:
        return refused(where, error.without_row, by_motion=isinstance(error, MotionError))
    except ValueError as error:
        return refused(where, f"is not JSON ({error}); send one frame a line, as JSON")


__all__ = ["Item", "Refused", "StreamFrame", "frames_of", "in_groups", "update_all"]

POLL_S = 0.2
"""How often a wait for input calls ``stop``."""

_CHUNK_BYTES = 2**16
_STANDARD_INPUT = "standard input"
_DATASET = "to track a dataset, say what matches its frames: --matcher structure"
_NOT_LINES = {
    b"PAR1": "a Parquet file",
    b"ARROW1": "an Arrow file",
    b"\xff\xff\xff\xff": "an Arrow stream",
    b"\xff\xfe": "text in UTF-16, as PowerShell pipes it, expected UTF-8",
}


def frames_of(
    source: Path | str,
    *,
    stop: Callable[[], bool] = lambda: False,
    stdin: BinaryIO | None = None,
) -> Iterator[Item]:
    """The frames of a source; an error that ends it too early is the last item.

    Args:
        source: a table, or "-" for standard input.
        stop: called before every frame and, while waiting, several times a second; True ends the
            frames.
        stdin: what "-" reads; standard input if None.

    Raises:
        FileError: at once, if there is no such source, or it has a motion that no vehicle has.
    """
    if str(source) == "-":
        if stdin is None and sys.stdin is None:
            raise FileError("standard input", "is closed; pipe frames in")
        return _until(stop, frames_of_input(stdin or sys.stdin.buffer, stop=stop))
    path = Path(source)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read ({error}); check the path") from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FileError(path, "is no file; pipe it in and give '-'")
    if stat.S_ISDIR(mode) or is_bag(path):
        raise FileError(path, f"is no table of correspondences; {_DATASET}")
    require_plausible_motion(path)
    return _until(stop, frames_of_table(path))


def _until(stop: Callable[[], bool], items: Iterator[Item]) -> Iterator[Item]:
    try:
        for item in items:
            if stop():
                return
            yield item
    except FileError as error:
        if not stop():
            yield Refused(str(error))


def frames_of_input(file: BinaryIO, *, stop: Callable[[], bool]) -> Iterator[Item]:
    """The frames of JSON lines.

    Args:
        file: for example standard input: if it has a descriptor, waiting for it can be stopped.
        stop: called while waiting, every ``POLL_S``; True ends the input.

    Raises:
        FileError: if the stream turns out not to be readable.
    """
    chunks = _chunks(file, stop)
    first = next(chunks, b"")
    while any(len(first) < len(mark) and mark.startswith(first) for mark in _NOT_LINES):
        if not (more := next(chunks, b"")):
            break
        first += more
    for mark, kind in _NOT_LINES.items():
        if first.startswith(mark):
            raise FileError(_STANDARD_INPUT, f"is {kind}; send a line of JSON per frame")
    yield from frames_of_lines(chain([first], chunks), _STANDARD_INPUT)


def _chunks(file: BinaryIO, stop: Callable[[], bool]) -> Iterator[bytes]:
    """The bytes of a file as they come, until it ends or is to be stopped."""
    read: Callable[[int], bytes | None] = getattr(file, "read1", file.read)
    ready = _poll(file)
    while not stop():
        if ready is not None and not ready.poll(1000 * POLL_S):
            continue
        try:
            some = read(_CHUNK_BYTES)
        except (OSError, ValueError) as error:
            raise FileError(_STANDARD_INPUT, f"cannot be read ({error}); restart") from error
        if some:
            yield some
        elif some is not None:
            return


def _poll(file: BinaryIO) -> select.poll | None:
    """A poll object for a file, or None if reading it never waits."""
    try:
        descriptor = file.fileno()
    except (OSError, ValueError):  # Bytes in memory, or closed.
        return None
    ready = select.poll()
    ready.register(descriptor, select.POLLIN)
    return ready


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
