"""Point clouds of PCL: .pcd files, ascii, binary and compressed (LZF)."""

import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.point_fields import (
    Field,
    RawCloud,
    binary_columns,
    choose_fields,
    raw_cloud,
    read_count,
    read_rows,
    truncated,
)
from factors.compiled import compiled

_HEADER_BYTES = 65536
_DATA = re.compile(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", re.MULTILINE)
_SIZES = struct.Struct("<II")  # compressed and uncompressed
_KINDS = {f"{letter}{size}" for letter in "IU" for size in (1, 2, 4, 8)} | {"F2", "F4", "F8"}
_PADDING = "_"
_MOST_BYTES = 2 * 2**30  # unpacked


def read_pcd(path: Path) -> RawCloud:
    """The points of a file, in the frame of the sensor, as they are stored.

    Fields may be of any type and count; those named ``_`` are padding. ``VIEWPOINT`` is the pose of
    the sensor in the world when it recorded the cloud. It is not applied, as PCL does not either:
    points of one sensor stay in its frame.
    """
    data = path.read_bytes()
    end = _DATA.search(data[:_HEADER_BYTES])
    if end is None:
        raise FileError(path, "has no complete .pcd header; is it complete?")
    count, fields = _layout(path, data[: end.start()].decode("ascii", "replace"))
    body, encoding = memoryview(data)[end.end() :], end[1].lower()
    if encoding not in _READERS:
        raise FileError(path, "has an unknown encoding in its header; write it as binary or ascii")
    names = [f.name for f in fields if f.count == 1 and f.name != _PADDING]
    choose_fields(path, names)  # before points are read as if they were right
    columns = _READERS[encoding](path, body, count, fields)
    named = {f.name: column for f, column in zip(fields, columns, strict=True) if f.count == 1}
    return raw_cloud(path, names, named.__getitem__)


def _layout(path: Path, header: str) -> tuple[int, list[Field]]:
    """The number of points and the fields of each."""
    lines = {words[0]: words[1:] for words in map(str.split, header.split("\n")) if words}
    try:
        names = lines.get("FIELDS") or lines["COLUMNS"]
        counts = [read_count(word) for word in lines.get("COUNT", ["1"] * len(names))]
        kinds = [a + b for a, b in zip(lines["TYPE"], lines["SIZE"], strict=True)]
        types = [f"<{kind.lower()}" for kind in kinds]
        fields = [Field(*each) for each in zip(names, types, counts, strict=True)]
        sides = [read_count(lines[side][0]) for side in ("WIDTH", "HEIGHT") if side in lines]
        points = read_count(lines["POINTS"][0]) if "POINTS" in lines else sides[0] * sides[1]
    except (KeyError, IndexError, ValueError) as error:
        raise FileError(path, f"has a malformed PCD header ({error})") from None
    whole = not sides or points == sides[0] * sides[-1] * (len(sides) > 1)
    if not whole or min(counts) < 1 or not set(kinds) <= _KINDS:
        raise FileError(path, "has a malformed PCD header: its FIELDS, SIZE, TYPE and COUNT, or "
                        "its WIDTH, HEIGHT and POINTS do not fit")  # fmt: skip
    if not points:
        raise FileError(path, "holds no point")
    return points, fields


def _ascii_columns(
    path: Path, body: memoryview, count: int, fields: Sequence[Field]
) -> Iterator[NDArray[Any]]:
    """The first number of each field; padding may be left out of the lines."""
    widths = [sum(f.count for f in fields), sum(f.count for f in fields if f.name != _PADDING)]
    rows = read_rows(path, body, count, widths)
    at, full = 0, rows.shape[1] == widths[0]
    for each in fields:
        yield rows[:, min(at, rows.shape[1] - 1)]
        at += each.count * (full or each.name != _PADDING)


def _compressed_columns(
    path: Path, body: memoryview, count: int, fields: Sequence[Field]
) -> Iterator[NDArray[Any]]:
    """The first number of each field: the fields lie one after the other, PCL's without padding."""
    packed, unpacked = _SIZES.unpack(body[:8]) if len(body) >= _SIZES.size else (1, 0)
    full = sum(each.bytes for each in fields) * count
    short = sum(each.bytes for each in fields if each.name != _PADDING) * count
    if len(body) < _SIZES.size + packed:
        raise truncated(path, count)
    fits = unpacked in (full, short) and unpacked <= min(packed * MOST_RATIO, _MOST_BYTES)
    data = np.frombuffer(body, np.uint8, packed, _SIZES.size)
    plain = unpack_lzf(data, unpacked) if fits else None
    if plain is None:
        raise FileError(path, f"its compressed data are not its {count} points; write it again")
    at = 0
    for each in fields:
        skipped = unpacked != full and each.name == _PADDING
        yield np.ndarray((0 if skipped else count,), each.kind, plain, at, (each.bytes,))
        at += 0 if skipped else each.bytes * count


_READERS = {
    b"ascii": _ascii_columns, b"binary": binary_columns, b"binary_compressed": _compressed_columns,
}  # fmt: skip


MOST_RATIO = 88
"""Three bytes stand for at most 264."""

_LITERALS, _LONG = 32, 7  # controls below are literal bytes; lengths from here on have a byte more


def unpack_lzf(data: NDArray[np.uint8], size: int) -> NDArray[np.uint8] | None:
    """(size,) the unpacked bytes; None if the data are damaged or unpack to another size."""
    out = np.empty(size, np.uint8)
    return out if _unpack(data, out) == size else None


@compiled(boundscheck=True)
def _unpack(data: Any, out: Any) -> int:  # noqa: PLR0911
    """Fill ``out``; the number of bytes written, -1 if the data refer beyond it or end early."""
    at, end = 0, 0
    while at < len(data):
        control: Any = np.int64(data[at])
        at += 1
        if control < _LITERALS:
            length = control + 1
            if at + length > len(data) or end + length > len(out):
                return -1
            for k in range(length):
                out[end + k] = data[at + k]
            at += length
        else:
            length = control >> 5
            if length == _LONG and at < len(data):
                length += np.int64(data[at])
                at += 1
            if at >= len(data):
                return -1
            start = end - ((control & 31) << 8) - np.int64(data[at]) - 1
            at += 1
            length += 2
            if start < 0 or end + length > len(out):
                return -1
            for k in range(length):
                out[end + k] = out[start + k]
        end += length
    return end
