"""PointCloud2 messages: fields in any order, of any type and byte order, organised or not."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.io.bags.messages import describe_message
from calibgraph.io.bags.transforms import stamp_ns_of
from calibgraph.io.clouds import TIMES, find_intensity, make_cloud, seconds_after, time_fields

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LIKE_A_TIME = re.compile(r"time|stamp|^ts?_|_ts?$|^(ts|dt|sec|nsec|usec|t\d)")


def cloud_from_message(message: Any, where: str = "") -> NDArray[np.float32]:
    """The points of a PointCloud2 that are returns; of rclpy, rospy, rosbags or another decoder.

    Args:
        message: any object with the fields of the message.
        where: for errors; frame and stamp if empty.

    Returns:
        (n, 4) x y z [m], and the intensity as recorded, NaN where there is none. Points with a
        coordinate that is not finite and points at the origin are no returns.

    Raises:
        DatasetError: if it has no x y z, or less data than it declares.
    """
    return points_of(message, where or describe_message(message))[0]


def points_of(
    message: Any, where: str, *, timed: bool = False
) -> tuple[NDArray[np.float32], Array | None]:
    """The points of a message that are returns, and if asked when each was taken.

    Returns:
        (n, 4) as of :func:`cloud_from_message`; (n,) seconds after the stamp, None without times.
    """
    fields = _structured(message, where)
    cloud = make_cloud(*(fields[name] for name in fields.dtype.names or ()))
    xyz = cloud[:, :3]
    with np.errstate(invalid="ignore"):  # a signalling NaN
        returned = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    names = time_fields(each.name for each in message.fields)[:1] if timed else []
    for name in names:
        times = _structured(message, where, names)[name][returned]
        return cloud[returned], seconds_after(stamp_ns_of(message), times, f"{where}: {name}")
    return cloud[returned], None


def has_points(message: Any, where: str) -> bool:
    """Whether a message holds a return, by its x alone: a scan that sees nothing has none."""
    x = _structured(message, where)["x"]
    with np.errstate(invalid="ignore"):
        return bool((np.isfinite(x) & (x != 0)).any())


def doubtful_time_fields(names: Iterable[str]) -> list[str]:
    """The fields that may be times by their names, and are not read."""
    return [name for name in names if name not in TIMES and _LIKE_A_TIME.search(name.lower())]


def _structured(message: Any, where: str, chosen: Sequence[str] = ()) -> NDArray[np.void]:
    """(n,) structured array of fields, by default x, y, z and an intensity, without a copy."""
    fields = {each.name: each for each in message.fields}
    intensity = find_intensity(fields)
    names = [*chosen] or ["x", "y", "z", *([intensity] if intensity else [])]
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
