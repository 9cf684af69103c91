"""The messages of a bag, and their addresses.

The address of a message is a path below its bag, ``BAG/TOPIC/NANOSECONDS-NUMBER.message``: when it
was recorded, and which of the topic's messages of that nanosecond it is. Such a path stands
wherever the path of an image or a cloud does.
"""

from __future__ import annotations

import os
import struct
import weakref
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from calibgraph.errors import FileError, needs_extra
from calibgraph.io.bags.storage import Topic, errors_in_one_line, is_bag, require_closed

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

LIVOX_CLOUDS = tuple(
    f"{package}/msg/CustomMsg"
    for package in ("livox_ros_driver", "livox_ros_driver2", "livox_interfaces")
)

_POINT = {"offset_time": (6, 0), "x": (7, 4), "y": (7, 8), "z": (7, 12), "reflectivity": (2, 16),
          "tag": (2, 17), "line": (2, 18)}  # fmt: skip
"""The type's code in PointField, and the offset."""
_POINT_BYTES = 19


def read_custom_msg(data: bytes, *, ros1: bool) -> Any:
    """A Livox CustomMsg as a PointCloud2, from its bytes as in ROS 1, or as CDR, which aligns.

    rosbags would make an object of every point. The message of livox_ros_driver,
    livox_ros_driver2 and livox_interfaces::

        Header header; uint64 timebase; uint32 point_num; uint8 lidar_id; uint8[3] rsvd
        CustomPoint[] points: uint32 offset_time; float32 x, y, z; uint8 reflectivity, tag, line
    """
    order = ">" if not ros1 and data[1] == 0 else "<"
    sec, nanosec, length = struct.unpack_from(f"{order}iII", data, 4)  # after number or form
    end = 16 + length
    start = end if ros1 else 4 + -(-(end - 4) // 8) * 8
    (count,) = struct.unpack_from(f"{order}8xI4xI", data, start)[1:]
    step = _POINT_BYTES if ros1 else _POINT_BYTES + 1
    points = bytes(data[start + 20 : start + 20 + count * step])
    if len(points) < count * step - (step - _POINT_BYTES):
        raise ValueError("truncated")
    stamp = SimpleNamespace(sec=sec, nanosec=nanosec)
    frame = bytes(data[16:end]).rstrip(b"\0").decode()
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=frame), height=1, width=count,
        fields=[SimpleNamespace(name=name, datatype=code, offset=at, count=1)
                for name, (code, at) in _POINT.items()],
        is_bigendian=order == ">", point_step=step, row_step=count * step,
        data=np.frombuffer(points.ljust(count * step, b"\0"), np.uint8),
    )  # fmt: skip


MESSAGE_SUFFIX = ".message"
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, POINT_CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
CLOUDS = (POINT_CLOUD, *LIVOX_CLOUDS)
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TREES = (TRANSFORMS, "tf/msg/tfMessage")  # the latter of tf before tf2, with the same fields

_MOST_OPEN_BAGS = 8
_LATEST_NS = 2**63 - 1


@dataclass(frozen=True)
class Message:
    """A message; ``number`` counts earlier ones of its topic in the same nanosecond."""

    topic: str
    record_ns: int
    number: int
    content: Any

    def path_in(self, bag: Path) -> Path:
        """The message's address."""
        name = f"{self.record_ns}-{self.number}{MESSAGE_SUFFIX}"
        return bag.joinpath(*self.topic.strip("/").split("/"), name)


def describe_message(message: Any) -> str:
    """A message that a program has received, for errors."""
    stamp = message.header.stamp
    return f"message of {message.header.frame_id} at {stamp.sec}.{stamp.nanosec:09d}"


class Bag:
    """An open bag. It is closed when it is no longer referred to."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = Lock()
        with errors_in_one_line(path):
            require_closed(path)
            with needs_extra("ros", f"{path}: reading ROS bags needs rosbags and mcap"):
                from calibgraph.io.bags.files import open_file
            self._recording = open_file(path)
        weakref.finalize(self, self._recording.close)
        self.topics = self._recording.topics

    def of_type(self, *types: str) -> list[Topic]:
        """The topics of these types that have messages, sorted by name."""
        return [each for each in self.topics.values() if each.type in types and each.count]

    def has(self, topic: str) -> bool:
        """Whether a topic has messages."""
        return topic in self.topics and bool(self.topics[topic].count)

    def messages(
        self, topics: Collection[str], start_ns: int = 0, stop_ns: int = _LATEST_NS
    ) -> Iterator[Message]:
        """The messages recorded from ``start_ns`` to before ``stop_ns``, in that order, lazily."""
        last: dict[str, tuple[int, int]] = {}
        with errors_in_one_line(self.path):
            for topic, record_ns, data in self._recording.messages(topics, start_ns, stop_ns):
                before, number = last.get(topic, (None, 0))
                last[topic] = record_ns, number + 1 if before == record_ns else 0
                content = self._deserialize(topic, record_ns, data)
                yield Message(topic, record_ns, last[topic][1], content)

    def next_time(self, topics: Collection[str], start_ns: int = 0) -> int | None:
        """When the first message of some topics was recorded from ``start_ns`` on [ns], if any."""
        with errors_in_one_line(self.path):
            found = self._recording.messages(topics, start_ns, _LATEST_NS)
            return next((record_ns for _, record_ns, _ in found), None)

    def first(self, topic: str) -> Any:
        """The content of a topic's first message."""
        for message in self.messages([topic]):
            return message.content
        raise FileError(self.path, f"has no message of {topic}; choose another topic")

    def read(self, topic: str, record_ns: int, number: int) -> tuple[bytes, Any]:
        """The bytes and the content of one message; threads may call this at the same time."""
        with self._lock, errors_in_one_line(self.path):
            found = self._recording.messages([topic], record_ns, record_ns + 1)
            data = [each for _, _, each in islice(found, number, number + 1)]
        if not data:
            raise FileError(self.path, f"has no message of {topic} recorded at {record_ns} ns")
        return data[0], self._deserialize(topic, record_ns, data[0])

    def _deserialize(self, topic: str, record_ns: int, data: bytes) -> Any:
        kind = self.topics[topic]
        ros1 = kind.encoding == "ros1"
        store = type_store(ros1=ros1)
        try:
            if kind.type in LIVOX_CLOUDS:
                return read_custom_msg(data, ros1=ros1)
            deserialize = store.deserialize_ros1 if ros1 else store.deserialize_cdr
            return deserialize(data, TRANSFORMS if kind.type in TREES else kind.type)
        except Exception as error:  # whatever the bytes make the parser raise
            raise FileError(
                self.path,
                f"the message of {topic} recorded at {record_ns} ns is no {kind.type} "
                f"({error or type(error).__name__}); choose another topic or other frames",
            ) from error


def read_message(path: Path) -> tuple[bytes, Any]:
    """The bytes and the content of the message with this address."""
    bag = next((parent for parent in path.parents if is_bag(parent)), None)
    if bag is None:
        raise FileError(path, "no such message: its bag is not there")
    topic = "/".join(path.relative_to(bag).parts[:-1])
    record_ns, _, number = path.stem.partition("-")
    if not (record_ns.isdecimal() and number.isdecimal()):
        raise FileError(path, "no such message; expected NANOSECONDS-NUMBER.message")
    opened = _kept_open(bag, bag.stat().st_mtime_ns)
    name = topic if topic in opened.topics else f"/{topic}"
    return opened.read(name, int(record_ns), int(number))


@lru_cache(_MOST_OPEN_BAGS)
def _kept_open(path: Path, _changed_ns: int) -> Bag:
    """The bag, opened once: that takes seconds where it is large."""
    return Bag(path)


def open_drive(bag: Bag, beside: Collection[Path] = ()) -> list[Bag]:
    """A bag, and others of its drive."""
    return [bag, *(Bag(path) for path in beside if path != bag.path)]


os.register_at_fork(after_in_child=_kept_open.cache_clear)  # parent and child would share offsets


@cache
def type_store(*, ros1: bool) -> Typestore:
    """The standard messages of ROS 1 or 2; definitions in a bag may be missing or malformed."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if TRANSFORMS not in store.fielddefs:  # ROS 1 has it in a package of its own
        store.register(
            get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS)
        )
    return store
