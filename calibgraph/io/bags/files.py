"""Files of bags, each as a recording: ROS 1 by rosbags, ROS 2 by sqlite3 and by the library mcap.

A recording has ``topics`` by name, and messages as bytes in the order in which they were recorded.
"""

import bz2
import sqlite3
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack
from copy import copy
from functools import partial
from heapq import merge
from io import BytesIO
from operator import itemgetter
from pathlib import Path, PurePath
from shlex import quote
from typing import Any

import lz4.frame
from mcap.reader import SeekingReader
from rosbags.rosbag1 import Reader

from calibgraph.errors import FileError
from calibgraph.files import read_yaml
from calibgraph.io.bags.storage import METADATA, REPAIR_ROS2, Topic

ENCODINGS = ("cdr", "ros1")
"""How messages of ROS 2 and of ROS 1 are serialized."""


def make_topic(name: str, type_: str, count: int, encoding: str) -> Topic:
    """A topic; a type of ROS 1 gets the name that it has in ROS 2."""
    if encoding not in ENCODINGS:
        return Topic(name, f"{type_} ({encoding or 'of no encoding'})", count, encoding)
    package, _, last = type_.rpartition("/")
    is_short = package and not package.endswith("/msg")
    return Topic(name, f"{package}/msg/{last}" if is_short else type_, count, encoding)


def topics_by_name(topics: Iterable[Topic]) -> dict[str, Topic]:
    """Topics, sorted by name; with the messages of all their publishers, files and types."""
    found: dict[str, Topic] = {}
    for each in sorted(topics, key=lambda topic: topic.name):
        before = found.get(each.name, each)
        same = (before.type, before.encoding) == (each.type, each.encoding)
        type_ = each.type if same else f"{before.type}, {each.type}"
        earlier = before.count if each.name in found else 0
        found[each.name] = Topic(each.name, type_, earlier + each.count, each.encoding)
    return found


Buffer = bytes | memoryview
Recorded = Iterator[tuple[str, int, bytes]]
"""Topic, time of recording [ns] and bytes of messages."""

_ALWAYS, _RATIO, _MOST = 2**26, 50, 2**30
"""Of one part: a black image of 20 MP is 60 MB and packs to nothing; other data of sensors shrink
to a fiftieth at most."""
_ALWAYS_WHOLE, _RATIO_WHOLE = 2**28, 1000


def unpack(path: Path, kind: str, data: Buffer) -> Buffer:
    """The content of a chunk or message, which may be compressed by bz2, lz4 or zstd.

    Raises:
        Exception: what the library raises for damaged data.
    """
    if kind in ("", "none"):
        return data
    most = max(_ALWAYS, min(_RATIO * len(data), _MOST))
    if kind == "zstd":
        import zstandard

        stated = zstandard.frame_content_size(data)  # -1 if it is not
        content: bytes = (
            zstandard.decompress(data) if 0 <= stated <= most
            else zstandard.ZstdDecompressor().stream_reader(data).read(most + 1)
        )  # fmt: skip
    elif kind == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(data, most + 1)
    elif kind == "bz2":
        content = bz2.BZ2Decompressor().decompress(data, most + 1)
    else:
        raise _unknown_compression(path, kind)
    if len(content) > most:
        raise FileError(
            path,
            f"{len(data)} bytes of it unpack to more than {most >> 20} MiB, which no recording "
            "does; record it again, in chunks of a few MiB",
        )
    return content


def _unknown_compression(path: Path, kind: str) -> FileError:
    return FileError(
        path,
        f"is compressed by {kind!r}; known are bz2, lz4 and zstd: write it again with "
        "`mcap compress` or `rosbag compress`",
    )


_MAGIC, _PACKINGS = b"\x89MCAP0\r\n", ("lz4", "zstd")
_KINDS = {bz2.decompress: "bz2", lz4.frame.decompress: "lz4"}
_TABLES = """
    SELECT count(*) FROM sqlite_master
    WHERE type = 'table' AND name IN ('messages', 'topics') AND sql LIKE 'CREATE TABLE %'"""
_TOPICS = """
    SELECT name, type, count(topic_id), serialization_format
    FROM topics LEFT JOIN messages ON topics.id = topic_id GROUP BY topics.id"""
_MESSAGES = """
    SELECT name, timestamp, data FROM messages JOIN topics ON topics.id = topic_id
    WHERE name IN ({}) AND timestamp >= ? AND timestamp < ? ORDER BY timestamp, messages.id"""
_LEAST_LIMIT = 10_000  # of sqlite3, for its statements


class Db3File:
    """A database, open for reading.

    It may be anyone's: it is not written, views and virtual tables are not read, and no value is
    longer than the file.
    """

    def __init__(self, path: Path) -> None:
        name = f"{path.absolute().as_uri()}?immutable=1"  # quotes %, ? and #
        self._database = sqlite3.connect(name, uri=True, check_same_thread=False)
        self.close = self._database.close
        try:
            self._database.setlimit(
                sqlite3.SQLITE_LIMIT_LENGTH, max(path.stat().st_size, _LEAST_LIMIT)
            )
            if self._database.execute(_TABLES).fetchone() != (2,):
                raise ValueError("it has no tables messages and topics")
            found = self._database.execute(_TOPICS)
            self.topics = topics_by_name(make_topic(*each) for each in found)
        except BaseException:
            self.close()
            raise

    def messages(self, topics: Collection[str], start_ns: int, stop_ns: int) -> Recorded:
        """The messages of some topics, by time."""
        query = _MESSAGES.format(", ".join("?" * len(topics)))
        yield from self._database.execute(query, [*topics, start_ns, stop_ns])


class McapFile:
    """An MCAP file, open for reading: its chunks are found by the index at the end.

    Recorders may leave out message indexes or the profile, and may write channels of any encoding
    beside ROS's. A file whose index lacks chunks or counts is not read.

    Raises:
        FileError: if its index is not whole, or it unpacks to more than a recording's can be.
        Exception: what the library raises for a damaged file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb")
        self.close = self._file.close
        try:
            self._read_index(path.stat().st_size)
        except BaseException:
            self.close()
            raise

    def _read_index(self, size: int) -> None:
        self._reader = SeekingReader(self._file, validate_crcs=True, record_size_limit=size)
        found = self._reader.get_summary()
        if self._file.seek(-len(_MAGIC), 2) and self._file.read() != _MAGIC:
            raise ValueError("its end is missing")
        of = found and found.statistics
        if (
            not (found and of)
            or (of.chunk_count, of.message_count)
            != (len(found.chunk_indexes), sum(of.channel_message_counts.values()))
            or (of.message_count and not found.chunk_indexes)
            or not of.channel_message_counts.keys() <= found.channels.keys()
            or not {c.schema_id for c in found.channels.values()} - {0} <= found.schemas.keys()
        ):
            raise FileError(
                self._path,
                "its index is not whole (chunks, channels and counts at the end); write one with "
                f"`mcap recover {quote(str(self._path))} -o whole.mcap`, and give that file",
            )
        for kind in {each.compression for each in found.chunk_indexes} - {"", "none", *_PACKINGS}:
            raise _unknown_compression(self._path, kind)
        content = sum(each.uncompressed_size for each in found.chunk_indexes)
        if content > max(_ALWAYS_WHOLE, _RATIO_WHOLE * size):
            raise FileError(
                self._path,
                f"its {size} bytes unpack to {content >> 20} MiB or more, which no recording does; "
                "record it again",
            )
        self.topics = topics_by_name(
            make_topic(
                each.topic,
                found.schemas[each.schema_id].name if each.schema_id else "of no type",
                of.channel_message_counts.get(number, 0),
                each.message_encoding,
            )
            for number, each in found.channels.items()
        )

    def messages(self, topics: Collection[str], start_ns: int, stop_ns: int) -> Recorded:
        """The messages of some topics, by time."""
        found = self._reader.iter_messages(topics, starting_at=start_ns, ending_before=stop_ns)
        for _, channel, message in found:
            yield channel.topic, message.log_time, message.data


class _Ros1Reader(Reader):
    """The library's, whose chunks do not unpack to any size."""

    def read_chunk(self) -> Any:
        """A chunk's place and how it is unpacked."""
        chunk: Any = super().read_chunk()
        kind = _KINDS.get(chunk.decompressor, "")
        return chunk._replace(decompressor=partial(unpack, Path(str(self.path)), kind))


class Ros1File:
    """A bag, open for reading."""

    def __init__(self, path: Path) -> None:
        self._reader = _Ros1Reader(path)
        self.close = self._reader.close
        self._reader.open()
        self.topics = topics_by_name(
            make_topic(each.topic, each.msgtype, each.msgcount, "ros1")
            for each in self._reader.connections
        )

    def messages(self, topics: Collection[str], start_ns: int, stop_ns: int) -> Recorded:
        """The messages of some topics, by time."""
        chosen = [each for each in self._reader.connections if each.topic in topics]
        if chosen:  # the library takes none for all
            part = copy(self._reader)
            part.current_chunk = (-1, BytesIO())  # its own, which it closes behind each chunk
            for connection, record_ns, data in part.messages(chosen, start_ns, stop_ns):
                yield connection.topic, record_ns, data


class BagFolder:
    """The files of a ROS 2 bag as one recording, of whichever storage and compression."""

    topics: dict[str, Topic]
    close: Callable[[], None]

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        stated = read_yaml(folder / METADATA)["rosbag2_bagfile_information"]
        mode = (stated.get("compression_mode") or "none").lower()
        files = [folder / PurePath(name).name for name in stated["relative_file_paths"]]
        for file in files:
            if not file.is_file():
                raise FileError(
                    folder,
                    f"its {METADATA} names {file.name}, which is not there; copy it there, or "
                    f"write the metadata again with `{REPAIR_ROS2.format(quote(str(folder)))}`",
                )
        if mode == "file":
            raise FileError(
                folder,
                f"its files are compressed as a whole: unpack them first with `unzstd "
                f"{files[0].name}`, and name what comes out in place of the folder",
            )
        self._compression = "zstd" if mode == "message" else ""
        with ExitStack() as opened:
            self._parts: list[Recording] = []
            for file in files:
                self._parts.append(open_file(file))
                opened.callback(self._parts[-1].close)
            self.topics = topics_by_name(t for part in self._parts for t in part.topics.values())
            self.close = opened.pop_all().close

    def messages(self, topics: Collection[str], start_ns: int, stop_ns: int) -> Recorded:
        """The messages of some topics, by time."""
        parts = (part.messages(topics, start_ns, stop_ns) for part in self._parts)
        for topic, record_ns, data in merge(*parts, key=itemgetter(1)):
            yield topic, record_ns, bytes(unpack(self._folder, self._compression, data))


Recording = Ros1File | McapFile | Db3File | BagFolder


def open_file(path: Path) -> Recording:
    """Open a bag by its suffix; of a folder, all files that its metadata.yaml names."""
    if path.is_dir():
        return BagFolder(path)
    kinds: dict[str, Callable[[Path], Recording]] = {".bag": Ros1File, ".mcap": McapFile}
    return kinds.get(path.suffix.lower(), Db3File)(path)
