"""The messages of a bag, through the library rosbags, and their addresses.

The address of a message is a path below its bag, ``BAG/TOPIC/NANOSECONDS-NUMBER.message``: when it
was recorded, and which of the topic's messages of that nanosecond it is. Such a path stands
wherever the path of an image or a cloud does.
"""

from __future__ import annotations

import os
import weakref
from bisect import bisect_left
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from functools import cache, lru_cache
from io import BytesIO
from itertools import islice
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from calibgraph.errors import CalibrationError, FileError, in_words
from calibgraph.io.bags.livox import LIVOX_CLOUDS, read_custom_msg

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2
    from rosbags.typesys.store import Typestore

MESSAGE_SUFFIX = ".message"
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO, POINT_CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
CLOUDS = (POINT_CLOUD, *LIVOX_CLOUDS)
TRANSFORMS = "tf2_msgs/msg/TFMessage"

_METADATA, _HEAD_BYTES = "metadata.yaml", 1000
_REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover"}
_REPAIR_ROS2 = "ros2 bag reindex"
_MOST_OPEN_BAGS = 8


def is_bag(path: Path | str) -> bool:
    """Whether a path is a ROS 1 bag, a file of a ROS 2 bag or the folder of one."""
    path = Path(path)
    if path.suffix.lower() in (".bag", ".mcap", ".db3") and path.is_file():
        return True
    metadata = path / _METADATA
    if not metadata.is_file():
        return False
    with metadata.open("rb") as file:
        return b"rosbag2" in file.read(_HEAD_BYTES)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: its name, the type of its messages and their number."""

    name: str
    type: str
    count: int


@dataclass(frozen=True)
class Message:
    """A message of a bag.

    Attributes:
        topic: its topic.
        record_ns: when it was recorded [ns].
        number: how many messages of the topic were recorded earlier in that nanosecond.
        content: its fields, named as in ROS.
    """

    topic: str
    record_ns: int
    number: int
    content: Any

    def path_in(self, bag: Path) -> Path:
        """The message's address."""
        name = f"{self.record_ns}-{self.number}{MESSAGE_SUFFIX}"
        return bag.joinpath(*self.topic.strip("/").split("/"), name)


class Bag:
    """An open bag. It is closed when it is no longer referred to.

    Attributes:
        path: its file or folder.
        topics: by name.
        start_ns, stop_ns: when the first message was recorded, and after the last [ns].
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = Lock()
        _require_closed(path)
        with _errors_in_one_line(path):
            self._reader = _reader(path)
            self._reader.open()
            weakref.finalize(self, self._reader.close)
            self._deserialize = _deserializer(path)
            self.start_ns, self.stop_ns = self._reader.start_time, self._reader.end_time
            self.topics = {
                name: Topic(name, str(info.msgtype), info.msgcount)
                for name, info in self._reader.topics.items()
            }

    def of_type(self, *types: str) -> list[Topic]:
        """The topics of these types that have messages, sorted by name."""
        return [each for each in self.topics.values() if each.type in types and each.count]

    def messages(
        self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[Message]:
        """The messages of some topics in the order of recording, read as they are asked for.

        Args:
            topics: names.
            start_ns: when the first was recorded at the earliest [ns].
            stop_ns: before which the last was recorded [ns].

        Raises:
            FileError: if the bag is damaged.
        """
        last: dict[str, tuple[int, int]] = {}
        with _errors_in_one_line(self.path):
            for topic, record_ns, data in self._raw(topics, start_ns, stop_ns):
                before, number = last.get(topic, (None, 0))
                last[topic] = record_ns, number + 1 if before == record_ns else 0
                content = self._deserialize(data, self.topics[topic].type)
                yield Message(topic, record_ns, last[topic][1], content)

    def first(self, topic: str) -> Any:
        """The content of a topic's first message.

        Raises:
            FileError: if there is none, or the bag is damaged.
        """
        for message in self.messages([topic]):
            return message.content
        raise FileError(self.path, f"has no message of {topic}; record it again")

    def read(self, topic: str, record_ns: int, number: int) -> tuple[bytes, Any]:
        """The bytes and the content of one message; threads may call this at the same time.

        Raises:
            FileError: if there is none, or the bag is damaged.
        """
        with self._lock, _errors_in_one_line(self.path):
            found = list(islice(self._raw([topic], record_ns, record_ns + 1), number, number + 1))
        if not found:
            raise FileError(self.path, f"has no message of {topic} recorded at {record_ns} ns")
        with _errors_in_one_line(self.path):
            return found[0][2], self._deserialize(found[0][2], self.topics[topic].type)

    def _raw(
        self, topics: Collection[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[str, int, bytes]]:
        chosen = [each for each in self._reader.connections if each.topic in topics]
        reader = _narrowed(self._reader, start_ns, stop_ns)
        if chosen:  # the library takes none for all
            for connection, record_ns, data in reader.messages(chosen, start_ns, stop_ns):
                yield connection.topic, record_ns, data


def read_message(path: Path) -> tuple[bytes, Any]:
    """The bytes and the content of the message with this address.

    Raises:
        FileError: if its bag or itself is missing, or the bag is damaged.
    """
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


os.register_at_fork(after_in_child=_kept_open.cache_clear)  # parent and child would share offsets


def _reader(path: Path) -> Reader1 | Reader2:
    try:
        from rosbags.rosbag1 import Reader as Reader1
        from rosbags.rosbag2 import Reader as Reader2
    except ImportError as error:
        raise CalibrationError(
            f"{path}: reading ROS bags needs rosbags: pip install 'calibgraph[ros]' ({error})"
        ) from error
    return Reader1(path) if path.suffix.lower() == ".bag" else Reader2(path)


def _require_closed(path: Path) -> None:
    """Check that a database's messages are all in its file: a recorder that crashed leaves some."""
    for log in (path.parent if path.is_file() else path).glob("*.db3-wal"):
        if log.stat().st_size and (path.is_dir() or log.name == f"{path.name}-wal"):
            raise FileError(
                path,
                f"was not closed: {log.name} holds messages that are not yet in it; close it with "
                f"`sqlite3 {log.name.removesuffix('-wal')} 'pragma wal_checkpoint(truncate)'`",
            )


def _narrowed(
    reader: Reader1 | Reader2, start_ns: int | None, stop_ns: int | None
) -> Reader1 | Reader2:
    """The reader; of ROS 1 with the part of its index that is asked for.

    It goes through its whole index from the start: 0.16 s for a window late in 200,000 messages.
    """
    indexes = getattr(reader, "indexes", None)
    if indexes is None or start_ns is None or stop_ns is None:
        return reader
    part: Any = copy(reader)
    part.current_chunk = (-1, BytesIO())  # closed when the next is read, so not the original's
    part.indexes = {
        connection: entries[
            bisect_left(entries, start_ns, key=_time_of) : bisect_left(
                entries, stop_ns, key=_time_of
            )
        ]
        for connection, entries in indexes.items()
    }
    return part  # type: ignore[no-any-return]


def _time_of(entry: Any) -> int:
    return int(entry.time)


def _deserializer(path: Path) -> Callable[[bytes, str], Any]:
    ros1 = path.suffix.lower() == ".bag"
    store = type_store(ros1=ros1)
    of_store: Callable[[bytes, str], Any] = (
        store.deserialize_ros1 if ros1 else store.deserialize_cdr
    )

    def read(data: bytes, type_: str) -> Any:
        if type_ in LIVOX_CLOUDS:
            return read_custom_msg(data, store.types, ros1=ros1)
        return of_store(data, type_)

    return read


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


@contextmanager
def _errors_in_one_line(path: Path) -> Iterator[None]:
    """Raise what a damaged bag makes the parsers raise, which may be anything, as FileError."""
    try:
        yield
    except (CalibrationError, PermissionError):
        raise
    except Exception as error:
        repair = _REPAIR.get(path.suffix.lower(), _REPAIR_ROS2)
        raise FileError(
            path,
            f"is truncated, was not closed or is no ROS bag ({in_words(error)}); "
            f"record or copy it again, or repair it with `{repair}`",
        ) from error
