"""Point clouds in .pcd and .ply files, by Open3D, which is asked for whole ones only."""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError, FileError


def read_pcd_or_ply(path: Path) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """(n, 3) points and (n,) intensities of a file, None if it has none.

    Raises:
        CalibrationError: if Open3D is missing.
        FileError: if the file is truncated, or of another format.
    """
    try:
        import open3d
    except ImportError as error:
        raise CalibrationError(
            f"{path}: reading {path.suffix} needs open3d: pip install 'calibgraph[pointcloud]', on "
            f"Debian or Ubuntu also apt-get install libusb-1.0-0 libgl1 libgomp1 libx11-6 ({error})"
        ) from error
    expected = _require_complete(path)
    if not expected:
        raise FileError(path, "holds no point")
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            cloud = open3d.t.io.read_point_cloud(path)
    except (RuntimeError, KeyError) as error:
        raise FileError(path, f"cannot be read by Open3D: {str(error).splitlines()[0]}") from error
    found = len(cloud.point.positions) if "positions" in cloud.point else 0
    if found != expected:
        raise FileError(path, f"{found} of {expected} points could be read; is it complete?")
    names = [name for name in ("intensity", "reflectivity", "i") if name in cloud.point]
    intensity = cloud.point[names[0]].numpy().ravel() if names else None
    return cloud.point.positions.numpy(), intensity


def _require_complete(path: Path) -> int:
    """Number of points in the header, if the file is long enough to hold them.

    Open3D silently fills the missing part of a truncated file with uninitialized memory.
    """
    data = path.read_bytes()
    header, body = _split_header(path, data)
    is_pcd = path.suffix.lower() == ".pcd"
    count, row_bytes, row_words = (_pcd_rows if is_pcd else _ply_rows)(path, header)
    encoding = _encoding(path, header)
    if encoding == "binary_compressed":
        sizes = struct.unpack("<II", body[:8]) if len(body) >= 8 else (1, 0)  # noqa: PLR2004
        complete = len(body) >= 8 + sizes[0] and sizes[1] >= count * row_bytes
    elif encoding == "ascii":
        rows = [line for line in body.splitlines() if line.strip()][:count]
        complete = len(rows) == count and all(len(row.split()) == row_words for row in rows)
        _require_numbers(path, rows)
    else:
        complete = len(body) >= count * row_bytes
    if not complete:
        raise FileError(path, f"is truncated: it ends before its {count} points; write it again")
    return count


def _require_numbers(path: Path, rows: list[bytes]) -> None:
    """Check that rows are numbers: Open3D reads words as zeros or as uninitialized memory."""
    try:
        np.array(b" ".join(rows).split(), dtype=np.bytes_).astype(np.float64)
    except ValueError as error:
        raise FileError(path, f"holds no numbers where its points should be: {error}") from error


def _split_header(path: Path, data: bytes) -> tuple[str, bytes]:
    pattern = rb"^DATA[^\n]*\n" if path.suffix.lower() == ".pcd" else rb"^end_header\r?\n"
    end = re.search(pattern, data[:65536], re.MULTILINE)
    if end is None:
        raise FileError(path, f"has no complete {path.suffix} header; is it complete?")
    return data[: end.end()].decode("ascii", "replace"), data[end.end() :]


_ENCODING = re.compile(
    r"^(?:DATA +(ascii|binary|binary_compressed)"
    r"|format +(ascii|binary_(?:little|big)_endian) .*)\s*$",
    re.MULTILINE,
)


def _encoding(path: Path, header: str) -> str:
    """How the points are written: Open3D guesses, or prints its own messages."""
    found = _ENCODING.search(header)
    if found is None:
        raise FileError(path, "has an unknown encoding in its header; write it as binary or ascii")
    return str(found[1] or found[2])


def _pcd_rows(path: Path, header: str) -> tuple[int, int, int]:
    fields = {words[0]: words[1:] for words in map(str.split, header.splitlines()) if words}
    try:
        count, names = int(fields["POINTS"][0]), fields["FIELDS"]
        sizes = np.array(fields["SIZE"], dtype=int)
        repeats = np.array(fields.get("COUNT", ["1"] * len(sizes)), dtype=int)
        row_bytes = int(sizes @ repeats)
        whole = count == int(fields["WIDTH"][0]) * int(fields["HEIGHT"][0])
    except (KeyError, IndexError, ValueError, OverflowError) as error:
        raise FileError(path, f"has a malformed PCD header ({error})") from error
    plain = [n for n, repeat in zip(names, repeats, strict=False) if repeat == 1]
    if not whole or len(names) != len(sizes) or min(repeats) < 1 or not set(sizes) <= _PCD_BYTES:
        raise FileError(path, "has a malformed PCD header: its FIELDS, SIZE and COUNT, or its "
                        "WIDTH, HEIGHT and POINTS do not fit")  # fmt: skip
    _require_coordinates(path, plain)
    return count, row_bytes, int(repeats.sum())


_PCD_BYTES = {1, 2, 4, 8}


def _require_coordinates(path: Path, names: Sequence[str]) -> None:
    """Check the fields: Open3D takes uninitialized memory for a coordinate that is missing."""
    for axis in "xyz":
        if names.count(axis) != 1:
            raise FileError(path, f"has the fields {' '.join(names)}, expected one {axis}")


_MOST_DIGITS = 18  # of a number of 64 bits
_PLY_BYTES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "float": 4, "int32": 4, "uint32": 4, "float32": 4, "double": 8,
    "float64": 8,
}  # fmt: skip


def _ply_rows(path: Path, header: str) -> tuple[int, int, int]:
    vertex = re.search(r"element vertex (\d+)\s*\n((?:(?:property|comment)[^\n]*\n)*)", header)
    found = re.findall(r"property (\w+) (\w+)", vertex[2]) if vertex else []
    if vertex is None or not found or any(kind not in _PLY_BYTES for kind, _ in found):
        raise FileError(path, "has no plain list of vertices in its PLY header")
    _require_coordinates(path, [name for _, name in found])
    if len(vertex[1]) > _MOST_DIGITS:
        raise FileError(path, f"claims a number of points of {len(vertex[1])} digits")
    return int(vertex[1]), sum(_PLY_BYTES[kind] for kind, _ in found), len(found)
