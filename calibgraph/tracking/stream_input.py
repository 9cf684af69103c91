"""Frames of correspondences from standard input: an Arrow stream, or lines of JSON."""

from __future__ import annotations

import json
import reprlib
import select
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.model.correspondences import Correspondences, as_confidence, concatenate
from calibgraph.model.table_columns import COORDINATES, INFORMATION
from calibgraph.tracking.stream_tables import (
    Item,
    StreamFrame,
    frames_in,
    refused,
    require_schema,
)

if TYPE_CHECKING:
    import pyarrow as pa

POLL_S = 0.2
"""How often a wait for more input asks whether to stop."""

MAX_CAMERAS = 1000
MAX_LINE_BYTES = 64 * 2**20
MAX_READ_BYTES = 256 * 2**20
"""Of one part of an Arrow message: a damaged length must not fill the memory."""

_CHUNK_BYTES = 2**16
_MAX_METADATA_LEVELS = 32
_STANDARD_INPUT = "standard input"
_ARROW_STREAM = b"\xff\xff\xff\xff"
_FILES_NOT_STREAMS = {b"PAR1": "a Parquet file", b"ARROW1": "an Arrow file"}


def frames_of_input(file: BinaryIO, *, stop: Callable[[], bool]) -> Iterator[Item]:
    """The frames of an Arrow IPC stream or of JSON lines; the first bytes say which it is.

    Arrow: the columns of the Parquet file; every record batch holds one or several whole frames,
    given in the order in which they first appear. A frame without rows cannot be said so.

    JSON lines: a frame a line, ``{"frame": 7, "cameras": {"left": {"u_px": [...], "v_px": [...],
    "x_m": [...], "y_m": [...], "z_m": [...]}}}``, in a camera optionally ``confidence``,
    ``i_uu_px`` with ``i_uv_px`` and ``i_vv_px``, and ``point_index``; beside ``frame`` optionally
    ``stamp_ns`` and ``metadata``. A line is given as soon as it is complete.

    Args:
        file: standard input, say: if it has a descriptor, waiting for it can be stopped.
        stop: asked while waiting, every ``POLL_S``; True ends what there is to read.

    Raises:
        FileError: wherever the stream turns out not to be readable.
    """
    feed = _Feed(file, stop)
    if feed.starts_with(_ARROW_STREAM):
        yield from _frames_of_arrow(feed)
        return
    for mark, kind in _FILES_NOT_STREAMS.items():
        if feed.starts_with(mark):
            raise FileError(_STANDARD_INPUT, f"is {kind}; send an Arrow stream or JSON lines")
    yield from _frames_of_lines(feed)


class _Feed:
    """The bytes of a file as they come, until it ends or is to be stopped.

    It is a Python file as far as Arrow needs one.
    """

    closed = False

    def __init__(self, file: BinaryIO, stop: Callable[[], bool]) -> None:
        self._read_some: Callable[[int], bytes | None] = getattr(file, "read1", file.read)
        self._ready = _poll(file)
        self._stop = stop
        self._held = b""

    def starts_with(self, mark: bytes) -> bool:
        """Whether the bytes begin with a mark; waits for no more of them than tell."""
        while len(self._held) < len(mark) and mark.startswith(self._held):
            more = self._wait_for_some(_CHUNK_BYTES)
            if not more:
                break
            self._held += more
        return self._held.startswith(mark)

    def some(self, most_bytes: int = _CHUNK_BYTES) -> bytes:
        """At least one byte, at most so many, or none at the end."""
        if self._held:
            some, self._held = self._held[:most_bytes], self._held[most_bytes:]
            return some
        return self._wait_for_some(most_bytes)

    def read(self, size_bytes: int) -> bytes:
        """So many bytes, fewer only at the end.

        Raises:
            FileError: if they are too many.
        """
        if size_bytes > MAX_READ_BYTES:
            found = f"a message of {size_bytes} bytes, expected at most {MAX_READ_BYTES}"
            raise FileError(_STANDARD_INPUT, f"holds {found}; send smaller batches")
        read = bytearray()
        while len(read) < size_bytes:
            some = self.some(min(size_bytes - len(read), _CHUNK_BYTES))
            if not some:
                break
            read += some
        return bytes(read)

    def close(self) -> None:
        """Nothing: the file belongs to the caller."""

    def _wait_for_some(self, most_bytes: int) -> bytes:
        while not self._stop():
            if self._ready is not None and not self._ready.poll(1000 * POLL_S):
                continue
            try:
                some = self._read_some(most_bytes)
            except (OSError, ValueError) as error:
                raise FileError(_STANDARD_INPUT, f"cannot be read ({error}); restart") from error
            if some is not None:
                return some
        return b""


def _poll(file: BinaryIO) -> select.poll | None:
    """What waits for a file, or None if it never needs to be waited for."""
    try:
        descriptor = file.fileno()
    except (OSError, ValueError):  # Bytes in memory, or closed.
        return None
    ready = select.poll()
    ready.register(descriptor, select.POLLIN)
    return ready


def _frames_of_arrow(feed: _Feed) -> Iterator[Item]:
    for number, batch in enumerate(_batches(feed), start=1):
        yield from _frames_of_batch(batch, f"{_STANDARD_INPUT}, batch {number}")


def _batches(feed: _Feed) -> Iterator[pa.RecordBatch]:
    """The record batches of an Arrow stream with the right columns.

    Raises:
        FileError: wherever the stream turns out not to be readable.
    """
    import pyarrow as pa
    from pyarrow import ipc

    count = 0
    try:
        with ipc.open_stream(pa.PythonFile(feed, mode="r")) as reader:
            require_schema(_STANDARD_INPUT, reader.schema)
            for count, batch in enumerate(reader, start=1):  # noqa: B007 - told by the error
                yield batch
    except (pa.ArrowException, OSError, ValueError) as error:
        message = f"the Arrow stream breaks off after {count} batches ({error}); send it again"
        raise FileError(_STANDARD_INPUT, message) from error


def _frames_of_batch(batch: pa.RecordBatch, where: str) -> Iterator[Item]:
    import pyarrow as pa

    try:
        batch.validate(full=True)
    except pa.ArrowException as error:
        yield refused(where, f"is damaged ({error}); send it again")
        return
    yield from frames_in(pa.Table.from_batches([batch]), where, ascending=False)


def _frames_of_lines(feed: _Feed) -> Iterator[Item]:
    for number, line in enumerate(_lines(feed), start=1):
        where = f"{_STANDARD_INPUT}, line {number}"
        if line is None:
            found = f"is longer than {MAX_LINE_BYTES} bytes"
            yield refused(where, f"{found}; send one frame a line, or fewer correspondences")
        elif line.strip():
            yield _line_or_refused(line, where)


def _lines(feed: _Feed) -> Iterator[bytes | None]:
    """Lines without their ends; None, at once, for one that is too long, and its rest is lost."""
    kept, too_long = bytearray(), False
    while chunk := feed.some():
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


def _line_or_refused(line: bytes, where: str) -> Item:
    try:
        return _frame_of_line(line)
    except CorrespondenceError as error:
        return refused(where, str(error))


def _frame_of_line(line: bytes) -> StreamFrame:
    """One frame from one JSON object.

    Raises:
        CorrespondenceError: with the first thing that is wrong.
    """
    keys = ("frame", "cameras"), ("stamp_ns", "metadata")
    content = _checked_keys(_json(line), "the line", *keys)
    number = _whole(content["frame"], "frame")
    stamp_ns = _whole(content["stamp_ns"], "stamp_ns") if "stamp_ns" in content else None
    cameras = _mapping(content["cameras"], "cameras")
    if len(cameras) > MAX_CAMERAS:
        raise CorrespondenceError(f"cameras: {len(cameras)}, expected at most {MAX_CAMERAS}")
    columns = {name: _columns(given, name) for name, given in cameras.items()}
    if any("point_index" in given for given in columns.values()):
        for given in columns.values():
            given.setdefault("point_index", np.full(len(given["u_px"]), -1))
    tables = [_table(name, given, number, stamp_ns) for name, given in columns.items()]
    table = concatenate([_empty_table(content.get("metadata", {})), *tables])
    return StreamFrame(number, stamp_ns, table)


def _json(line: bytes) -> Any:
    try:
        return json.loads(
            line.decode("utf-8"), parse_constant=_refuse_constant, object_pairs_hook=_unique
        )
    except UnicodeDecodeError as error:
        found = f"is not UTF-8 ({error.reason} at byte {error.start})"
    except json.JSONDecodeError as error:
        found = f"is not JSON ({error.msg} at column {error.colno})"
    except RecursionError:
        found = "is nested too deeply"
    except ValueError as error:  # Also what Python says of a number of thousands of digits.
        found = f"is not to be read: {error}"
    raise CorrespondenceError(f"{found}; send one frame a line, as JSON")


def _refuse_constant(token: str) -> None:
    raise ValueError(f"{token} is no number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    mapping: dict[str, Any] = {}
    for key, value in pairs:
        if key in mapping:
            raise ValueError(f"key {_short(key)} is given twice")
        mapping[key] = value
    return mapping


def _mapping(given: object, what: str) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise CorrespondenceError(f"{what} must be a JSON object, found {_short(given)}")
    return given


def _checked_keys(
    given: object, what: str, required: Sequence[str], optional: Sequence[str]
) -> dict[str, Any]:
    """A mapping with these keys and no others."""
    mapping, known = _mapping(given, what), (*required, *optional)
    for key in mapping:
        if key not in known:
            raise CorrespondenceError(
                f"{what}: unknown key {_short(key)}; known are {', '.join(known)}"
            )
    for key in required:
        if key not in mapping:
            raise CorrespondenceError(f"{what}: key {key!r} is missing; add it")
    return mapping


def _whole(value: object, what: str) -> int:
    if type(value) is not int or not -(2**63) <= value < 2**63:
        found = f"found {_short(value)}"
        raise CorrespondenceError(f"{what} must be a whole number of 64 bits, {found}")
    return value


def _columns(given: object, camera: str) -> dict[str, NDArray[Any]]:
    """The columns of one camera, of one length."""
    what = f"camera {_short(camera)}"
    optional = ("confidence", "point_index", *INFORMATION)
    lists = _checked_keys(given, what, COORDINATES, optional)
    partial = [key for key in INFORMATION if key in lists]
    if partial and len(partial) < len(INFORMATION):
        raise CorrespondenceError(f"{what}: has only {partial} of {list(INFORMATION)}; add all")
    columns = {key: _numbers(values, key, what) for key, values in lists.items()}
    lengths = {key: len(column) for key, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise CorrespondenceError(f"{what}: the lists differ in length: {lengths}")
    return columns


def _numbers(values: object, key: str, what: str) -> NDArray[Any]:
    whole = key == "point_index"
    kind = "whole numbers" if whole else "numbers"
    if not isinstance(values, list):
        raise CorrespondenceError(f"{what}: {key} must be a list of {kind}, found {_short(values)}")
    kinds = (int,) if whole else (int, float)
    if not set(map(type, values)) <= set(kinds):  # A bool is an int, but its type is not int.
        row = next(row for row, value in enumerate(values) if type(value) not in kinds)
        found = f"found {_short(values[row])} in row {row}"
        raise CorrespondenceError(f"{what}: {key} must hold {kind}, {found}")
    try:
        return np.array(values, np.int64 if whole else np.float64)
    except OverflowError as error:
        raise CorrespondenceError(f"{what}: {key} holds a number that is too large") from error


def _table(
    camera: str, columns: dict[str, NDArray[Any]], frame: int, stamp_ns: int | None
) -> Correspondences:
    """One camera's rows."""
    n = len(columns["u_px"])
    information = [columns[key] for key in INFORMATION if key in columns]
    return Correspondences(
        cameras=(camera,),
        camera_index=np.zeros(n, np.int32),
        frame=np.full(n, frame, np.int64),
        pixels_px=np.stack([columns[key] for key in COORDINATES[:2]], axis=1),
        points_lidar_m=np.stack([columns[key] for key in COORDINATES[2:]], axis=1),
        confidence=as_confidence(columns.get("confidence", np.ones(n))),
        information_px=np.stack(information, axis=1) if information else None,
        stamp_ns=None if stamp_ns is None else np.full(n, stamp_ns, np.int64),
        point_index=columns.get("point_index"),
    )


def _empty_table(metadata: Any) -> Correspondences:
    """A table without rows that says where the frame comes from."""
    if not _is_shallow(metadata, _MAX_METADATA_LEVELS):
        raise CorrespondenceError(f"metadata has more than {_MAX_METADATA_LEVELS} levels")
    return Correspondences(
        cameras=(),
        camera_index=np.empty(0, np.int32),
        frame=np.empty(0, np.int64),
        pixels_px=np.empty((0, 2)),
        points_lidar_m=np.empty((0, 3)),
        confidence=np.empty(0, np.float32),
        metadata=metadata,
    )


def _is_shallow(value: object, levels: int) -> bool:
    if not isinstance(value, (dict, list)):
        return True
    children = value.values() if isinstance(value, dict) else value
    return levels > 0 and all(_is_shallow(child, levels - 1) for child in children)


def _short(value: object) -> str:
    return reprlib.repr(value)
