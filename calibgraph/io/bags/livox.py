"""Livox CustomMsg as PointCloud2, from its bytes: rosbags would make an object of every point.

The message of livox_ros_driver, livox_ros_driver2 and livox_interfaces:

    Header header; uint64 timebase; uint32 point_num; uint8 lidar_id; uint8[3] rsvd; CustomPoint[] points
    CustomPoint: uint32 offset_time; float32 x, y, z; uint8 reflectivity, tag, line
"""  # noqa: E501

from typing import Any

import numpy as np

LIVOX_CLOUDS = tuple(
    f"{package}/msg/CustomMsg"
    for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)

_FIELDS = {"offset_time": (6, 0), "x": (7, 4), "y": (7, 8), "z": (7, 12),
           "reflectivity": (2, 16), "tag": (2, 17), "line": (2, 18)}  # fmt: skip
"""The type's code in PointField, and the offset."""
_POINT_BYTES = 19
_TAIL_BYTES = 8 + 4 + 1 + 3 + 4  # timebase to the number of points


def read_custom_msg(data: bytes, types: Any, *, ros1: bool) -> Any:
    """The PointCloud2 of a CustomMsg that is serialized as in ROS 1, or as CDR, which aligns."""
    big_endian = not ros1 and data[1] == 0
    order = ">" if big_endian else "<"
    body = np.frombuffer(data, np.uint8, offset=0 if ros1 else 4)

    def number(at: int, kind: str = "u4") -> int:
        return int(body[at : at + np.dtype(kind).itemsize].view(order + kind)[0])

    stamp_at = 4 if ros1 else 0  # after the number of the message
    text_at, length = stamp_at + 12, number(stamp_at + 8)
    frame = body[text_at : text_at + length].tobytes().rstrip(b"\0").decode()
    end = text_at + length
    points_at = (end if ros1 else -(-end // 8) * 8) + _TAIL_BYTES
    count = number(points_at - 4)
    step = _POINT_BYTES if ros1 else _POINT_BYTES + 1
    points = np.zeros(count * step, np.uint8)
    taken = points[: len(points) - (step - _POINT_BYTES if count else 0)]
    taken[:] = body[points_at : points_at + len(taken)]  # raises: truncated
    stamp = types["builtin_interfaces/msg/Time"](number(stamp_at, "i4"), number(stamp_at + 4))
    header = types["std_msgs/msg/Header"](
        stamp=stamp, frame_id=frame, **({"seq": number(0)} if ros1 else {})
    )
    return _cloud(types, header, points, step, big_endian=big_endian)


def _cloud(types: Any, header: Any, points: Any, step: int, *, big_endian: bool) -> Any:
    """A PointCloud2 of points of ``step`` bytes."""
    fields = [
        types["sensor_msgs/msg/PointField"](name=name, offset=offset, datatype=code, count=1)
        for name, (code, offset) in _FIELDS.items()
    ]
    return types["sensor_msgs/msg/PointCloud2"](
        header=header, height=1, width=len(points) // step, fields=fields,
        is_bigendian=big_endian, point_step=step, row_step=len(points), data=points,
        is_dense=True,
    )  # fmt: skip
