"""Frames of correspondences from a Parquet or CSV file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibgraph.errors import CorrespondenceError, FileError, MotionError
from calibgraph.files import require_file
from calibgraph.io.tables import (
    arrow_reads,
    from_arrow,
    open_parquet,
    read_arrow,
    require_rows,
)
from calibgraph.model.correspondences import (
    TWIST,
    TWIST_RULE,
    Correspondences,
    beyond_vehicles,
    check_schema,
)

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
        yield from _frames_in(table, str(path))


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


def _frames_in(table: pa.Table, where: str) -> Iterator[Item]:
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
