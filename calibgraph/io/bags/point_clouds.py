"""PointCloud2 messages: fields in any order, of any type and byte order, organised or not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_INTENSITY = ("intensity", "reflectivity", "i")
_TIMES = ("t", "time", "timestamp", "offset_time", "time_offset")  # Ouster, Velodyne, Hesai, Livox


def points_of(message: Any, where: str) -> NDArray[np.float32]:
    """The points of a message that are returns.

    Args:
        message: a PointCloud2.
        where: the message, for errors.

    Returns:
        (n, 4) x y z [m], and the intensity as recorded, NaN where there is none. Points with a
        coordinate that is not finite and points at the origin are no returns.

    Raises:
        DatasetError: if it has no x y z, or less data than it declares.
    """
    points = _structured(message, where)
    cloud = np.full((len(points), 4), np.nan, dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # becomes infinite, or is a signalling NaN
        for column, name in enumerate(points.dtype.names or ()):
            cloud[:, column] = points[name]
        xyz = cloud[:, :3]
        returned: NDArray[np.bool_] = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    return np.asarray(cloud[returned], dtype=np.float32)


def has_points(message: Any, where: str) -> bool:
    """Whether a message holds a return, by its x alone: a scan that sees nothing has none."""
    x = _structured(message, where)["x"]
    with np.errstate(invalid="ignore"):
        return bool((np.isfinite(x) & (x != 0)).any())


def time_fields(message: Any) -> list[str]:
    """The fields that give each point a time: such clouds are often as they were scanned."""
    return [each.name for each in message.fields if each.name in _TIMES]


def _structured(message: Any, where: str) -> NDArray[np.void]:
    """(n,) structured array of x, y, z and the intensity if there is one, without a copy."""
    fields = {each.name: each for each in message.fields}
    names = ["x", "y", "z", *[name for name in _INTENSITY if name in fields][:1]]
    order = ">" if message.is_bigendian else "<"
    try:
        kind = np.dtype(
            {
                "names": names,
                "formats": [order + _TYPES[fields[name].datatype] for name in names],
                "offsets": [fields[name].offset for name in names],
                "itemsize": message.point_step,
            }
        )
    except (KeyError, ValueError) as error:
        found = ", ".join(fields) or "none"
        raise DatasetError(
            f"{where}: its fields {found} have no x y z as numbers within point_step; choose "
            "another topic"
        ) from error
    return _rows(message, where).view(kind)[:, 0]


def _rows(message: Any, where: str) -> NDArray[np.uint8]:
    """(n, point_step) the bytes of each point; rows of organised clouds may be padded."""
    width, height = message.width * message.point_step, message.height
    step = max(message.row_step, width) if height > 1 else width
    data = np.ascontiguousarray(message.data)
    if not message.point_step or len(data) < step * (height - 1) + width:
        raise DatasetError(
            f"{where}: has {len(data)} bytes for {message.width} x {height} points of "
            f"{message.point_step} bytes; record it again"
        )
    if height <= 1 or step == width:
        return data[: height * width].reshape(-1, message.point_step)
    padded = np.lib.stride_tricks.as_strided(data, (height, width), (step, 1), writeable=False)
    return np.ascontiguousarray(padded).reshape(-1, message.point_step)
