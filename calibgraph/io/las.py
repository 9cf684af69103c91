"""Point clouds in .las and .laz files, by laspy."""

import struct
from pathlib import Path

import numpy as np

from calibgraph.errors import FileError, needs_extra
from calibgraph.io.point_fields import RawCloud, make_cloud

_CHUNK = 1_000_000
_HEADER = struct.Struct("<4s90sHIIBH")  # its size, the points' offset, the records before them, ...
_RECORD_BYTES = 54  # of a record's header
_END_RECORDS = struct.Struct("<QI")  # of version 1.4: where those after the points begin, how many
_END_RECORDS_AT, _WITH_END_RECORDS, _END_RECORD_BYTES = 235, 375, 60


def read_las(path: Path) -> RawCloud:
    """The points of a file of one scan, in the LiDAR frame.

    Raises:
        CalibrationError: if laspy is missing.
        FileError: if the file is damaged, or ends before its points.
    """
    with needs_extra("las", f"{path}: reading {path.suffix} needs laspy"):
        import laspy
    _require_header(path)
    try:
        with laspy.open(path) as file:
            expected = file.header.point_count
            names = tuple(file.header.point_format.dimension_names)
            parts = [
                make_cloud(chunk.x, chunk.y, chunk.z, chunk.intensity)
                for chunk in file.chunk_iterator(_CHUNK)
            ]
    except Exception as error:  # laspy's own, its decoders', and numpy's
        raise FileError(path, f"cannot be read as LAS ({error}); is it complete?") from error
    points = np.concatenate(parts or [np.empty((0, 4), np.float32)])
    if len(points) != expected:
        raise FileError(path, f"is truncated: {len(points)} of {expected} points; write it again")
    return RawCloud(points, names)


def _require_header(path: Path) -> None:
    """Check what a header claims: laspy would read billions of records that are not there."""
    with path.open("rb") as file:
        head = file.read(_WITH_END_RECORDS)
        size = file.seek(0, 2)
    if len(head) < _HEADER.size or not head.startswith(b"LASF"):
        raise FileError(path, "cannot be read as LAS (it has no header); is it complete?")
    _, _, header_bytes, offset, records, _, point_bytes = _HEADER.unpack_from(head)
    fits = header_bytes + records * _RECORD_BYTES <= offset <= size and point_bytes > 0
    if header_bytes >= _WITH_END_RECORDS and len(head) == _WITH_END_RECORDS:
        start, count = _END_RECORDS.unpack_from(head, _END_RECORDS_AT)
        fits = fits and (count == 0 or start + count * _END_RECORD_BYTES <= size)
    if not fits:
        raise FileError(path, "cannot be read as LAS (its header claims more than the file holds)")
