"""MCAP files, through the library mcap: with a whole index, a part of one, or none.

Recorders may leave out message indexes, chunk indexes, statistics, chunks or the profile, and may
write channels of any encoding beside ROS's.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush
from itertools import accumulate, count
from pathlib import Path
from struct import Struct
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk

from calibgraph.errors import FileError
from calibgraph.io.bags.recording import make_topic, topics_by_name

_MAGIC, _HEAD = b"\x89MCAP0\r\n", Struct("<BQ")
_MESSAGE_BYTES = 22  # before the data: channel, number, two times
_COMPRESSIONS = ("", "lz4", "zstd")
_LATEST_NS = 2**64


class _Block(NamedTuple):
    """A chunk of messages, or one message outside of chunks.

    Attributes:
        start_ns, end_ns: when its first and its last message were recorded.
        offset: where its record starts in the file.
        channels: of its messages; None if unknown.
    """

    start_ns: int
    end_ns: int
    offset: int
    channels: frozenset[int] | None


@dataclass
class _Index:
    """What is in a file: schemas and channels by id, numbers of messages by channel, blocks."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    blocks: list[_Block] = field(default_factory=list)

    def add(self, records: Collection[McapRecord], offset: int) -> None:
        """Count the records of a chunk at this offset, or a record outside of chunks."""
        for each in records:
            if isinstance(each, Schema):
                self.schemas[each.id] = each
            elif isinstance(each, Channel):
                self.channels[each.id] = each
        sent = [each for each in records if isinstance(each, Message)]
        if sent:
            times = [each.log_time for each in sent]
            channels = frozenset(each.channel_id for each in sent)
            self.blocks.append(_Block(min(times), max(times), offset, channels))
            self.counts.update(each.channel_id for each in sent)


class McapFile:
    """An MCAP file, open for reading; see :class:`calibgraph.io.bags.recording.Recording`.

    Where its index is not whole, the file is read once to make one.

    Raises:
        FileError: if it is compressed in an unknown way.
        Exception: what the library raises for a damaged file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb")
        try:
            self._require_whole()
            index = self._stated_index() or self._scanned_index()
        except BaseException:
            self._file.close()
            raise
        self._channels = index.channels
        self._blocks = sorted(index.blocks, key=lambda block: block.start_ns)
        self._starts_ns = [block.start_ns for block in self._blocks]
        self._latest_ends_ns = [*accumulate((block.end_ns for block in self._blocks), max)]
        self.start_ns = min((each.start_ns for each in self._blocks), default=_LATEST_NS)
        self.stop_ns = max((each.end_ns + 1 for each in self._blocks), default=0)
        self.topics = topics_by_name(
            make_topic(
                each.topic,
                getattr(index.schemas.get(each.schema_id), "name", "of no type"),
                index.counts[number],
                each.message_encoding,
            )
            for number, each in index.channels.items()
        )

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and bytes of the messages of some topics, by time."""
        chosen = {n: each.topic for n, each in self._channels.items() if each.topic in topics}
        start, stop = start_ns or 0, _LATEST_NS if stop_ns is None else stop_ns
        waiting: list[tuple[int, int, str, bytes]] = []
        number = count()
        for block in self._blocks_within(start, stop):
            if block.channels is not None and block.channels.isdisjoint(chosen):
                continue
            while waiting and waiting[0][0] < block.start_ns:
                time_ns, _, topic, data = heappop(waiting)
                yield topic, time_ns, data
            for each in self._records_at(block.offset):
                if not isinstance(each, Message) or each.channel_id not in chosen:
                    continue
                if start <= each.log_time < stop:
                    topic = chosen[each.channel_id]
                    heappush(waiting, (each.log_time, next(number), topic, each.data))
        while waiting:
            time_ns, _, topic, data = heappop(waiting)
            yield topic, time_ns, data

    def _blocks_within(self, start_ns: int, stop_ns: int) -> Iterator[_Block]:
        first = bisect_left(self._latest_ends_ns, start_ns)
        for block in self._blocks[first : bisect_left(self._starts_ns, stop_ns)]:
            if block.end_ns >= start_ns:
                yield block

    def _records_at(self, offset: int, *, without_data: bool = False) -> list[McapRecord]:
        """The record at an offset, of a chunk those in it; none of the kinds that are not read."""
        self._file.seek(offset)
        stream = ReadDataStream(self._file)
        opcode, length = _HEAD.unpack(stream.read(_HEAD.size))
        if opcode == Opcode.CHUNK:
            return self._in_chunk(Chunk.read(stream))
        if opcode == Opcode.MESSAGE:
            return [Message.read(stream, _MESSAGE_BYTES if without_data else length)]
        if opcode == Opcode.SCHEMA:
            return [Schema.read(stream)]
        return [Channel.read(stream)] if opcode == Opcode.CHANNEL else []

    def _in_chunk(self, chunk: Chunk) -> list[McapRecord]:
        if chunk.compression not in _COMPRESSIONS:  # the library takes it for none
            raise FileError(
                self._path,
                f"its chunks are compressed by {chunk.compression!r}; known are lz4 and zstd: "
                "write it again with `mcap compress`",
            )
        return breakup_chunk(chunk, validate_crc=True)

    def _require_whole(self) -> None:
        """Check the marks at both ends."""
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it does not start as an MCAP file")
        self._file.seek(-len(_MAGIC), 2)
        if self._file.read() != _MAGIC:
            raise ValueError("its end is missing")

    def _stated_index(self) -> _Index | None:
        """That at the end of the file; None if a part of it is missing."""
        found = SeekingReader(self._rewound()).get_summary()
        if found is None or found.statistics is None or not found.chunk_indexes:
            return None
        stated, counts = found.statistics, Counter(found.statistics.channel_message_counts)
        schemas = {each.schema_id for each in found.channels.values()} - {0}
        if (
            len(found.chunk_indexes) != stated.chunk_count
            or counts.total() != stated.message_count
            or not counts.keys() <= found.channels.keys()
            or not schemas <= found.schemas.keys()
        ):
            return None
        blocks = [
            _Block(
                each.message_start_time,
                each.message_end_time,
                each.chunk_start_offset,
                frozenset(each.message_index_offsets) or None,
            )
            for each in found.chunk_indexes
            if each.message_end_time
        ]
        return _Index(found.schemas, found.channels, counts, blocks)

    def _rewound(self) -> IO[bytes]:
        self._file.seek(0)
        return self._file

    def _scanned_index(self) -> _Index:
        """That of all records before the end of the data."""
        index, offset = _Index(), len(_MAGIC)
        while True:
            self._file.seek(offset)
            opcode, length = _HEAD.unpack(self._file.read(_HEAD.size))
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return index
            index.add(self._records_at(offset, without_data=True), offset)
            offset += _HEAD.size + length
