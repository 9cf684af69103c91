"""MCAP files, with the records of the library mcap: chunks are found by the index at the end.

Recorders may leave out message indexes or the profile, and may write channels of any encoding
beside ROS's. A file whose index lacks chunks or counts is not read.
"""

from bisect import bisect_left
from collections.abc import Collection, Iterator
from heapq import heappop, heappush
from io import BytesIO
from itertools import accumulate, count
from pathlib import Path
from struct import Struct
from zlib import crc32

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics

from calibgraph.errors import FileError
from calibgraph.io.bags.recording import make_topic, topics_by_name
from calibgraph.io.bags.unpacking import require_plausible, unpack

_MAGIC, _HEAD, _MESSAGE = b"\x89MCAP0\r\n", Struct("<BQ"), Struct("<HIQQ")
_CHUNK, _LENGTH_BYTES = Struct("<QQQII"), 8
"""Times, size, checksum, length of the compression's name; behind the name that of the data."""
_FOOTER_BYTES = _HEAD.size + 20
_KNOWN = frozenset(map(int, Opcode))


class McapFile:
    """An MCAP file, open for reading; see :class:`calibgraph.io.bags.recording.Recording`.

    Raises:
        FileError: if its index is not whole, or it unpacks to more than a recording's can be.
        Exception: what the library raises for a damaged file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("rb")
        try:
            self._read_index()
        except BaseException:
            self._file.close()
            raise

    def _read_index(self) -> None:
        """Read the topics, and where the chunks are, at the end of the file."""
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        chunks: list[ChunkIndex] = []
        counts: dict[int, int] = {}
        stated = (-1, -1)
        for opcode, stream in self._summary():
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                channels[channel.id] = channel
            elif opcode == Opcode.CHUNK_INDEX:
                chunks.append(ChunkIndex.read(stream))
            elif opcode == Opcode.STATISTICS:
                statistics = Statistics.read(stream)
                counts = statistics.channel_message_counts
                stated = statistics.chunk_count, statistics.message_count
        named = {each.schema_id for each in channels.values()} - {0}
        if (
            stated != (len(chunks), sum(counts.values()))
            or (stated[1] and not chunks)
            or not counts.keys() <= channels.keys()
            or not named <= schemas.keys()
        ):
            raise FileError(
                self._path,
                "its index is not whole (chunks, channels and counts at the end); write one with "
                f"`mcap recover {self._path.name} -o whole.mcap`, and give that file",
            )
        size = self._path.stat().st_size
        if any(each.chunk_start_offset + each.chunk_length > size for each in chunks):
            raise ValueError("its index names chunks behind its end")
        require_plausible(self._path, size, sum(each.uncompressed_size for each in chunks))
        self._channels = {number: each.topic for number, each in channels.items()}
        self._chunks = sorted(chunks, key=lambda each: each.message_start_time)
        self._starts_ns = [each.message_start_time for each in self._chunks]
        self._latest_ns = [*accumulate((each.message_end_time for each in self._chunks), max)]
        self.topics = topics_by_name(
            make_topic(
                each.topic,
                schemas[each.schema_id].name if each.schema_id else "of no type",
                counts.get(number, 0),
                each.message_encoding,
            )
            for number, each in channels.items()
        )

    def _summary(self) -> Iterator[tuple[int, ReadDataStream]]:
        """The records at the end of the file, between its data and its footer."""
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise ValueError("it does not start as an MCAP file")
        end = self._file.seek(-len(_MAGIC), 2) - _FOOTER_BYTES
        if self._file.read() != _MAGIC:
            raise ValueError("its end is missing")
        self._file.seek(end)
        ((_, footer),) = _records(self._file.read(_FOOTER_BYTES))
        start = Footer.read(ReadDataStream(BytesIO(footer))).summary_start or end
        self._file.seek(start)
        for opcode, body in _records(self._file.read(max(end - start, 0))):
            yield opcode, ReadDataStream(BytesIO(body))

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and bytes of the messages of some topics, by time."""
        chosen = {number: topic for number, topic in self._channels.items() if topic in topics}
        waiting: list[tuple[int, int, str, bytes]] = []
        number = count()
        first = bisect_left(self._latest_ns, start_ns)
        for chunk in self._chunks[first : bisect_left(self._starts_ns, stop_ns)]:
            channels = chunk.message_index_offsets.keys()  # none if the file has no such index
            if chunk.message_end_time < start_ns or (channels and channels.isdisjoint(chosen)):
                continue
            while waiting and waiting[0][0] < chunk.message_start_time:
                time_ns, _, topic, data = heappop(waiting)
                yield topic, time_ns, data
            for opcode, body in _records(self._content(chunk)):
                if opcode != Opcode.MESSAGE:
                    continue
                channel, _, time_ns, _ = _MESSAGE.unpack_from(body)
                if channel in chosen and start_ns <= time_ns < stop_ns:
                    message = bytes(body[_MESSAGE.size :])
                    heappush(waiting, (time_ns, next(number), chosen[channel], message))
        while waiting:
            time_ns, _, topic, data = heappop(waiting)
            yield topic, time_ns, data

    def _content(self, index: ChunkIndex) -> bytes | memoryview:
        """The records of a chunk."""
        self._file.seek(index.chunk_start_offset)
        head = _HEAD.unpack(self._file.read(_HEAD.size))
        if head != (Opcode.CHUNK, index.chunk_length - _HEAD.size):
            raise ValueError("a chunk is not where its index states")
        body = memoryview(self._file.read(head[1]))
        *_, checksum, length = _CHUNK.unpack_from(body)
        end = _CHUNK.size + length
        kind, packed = str(body[_CHUNK.size : end], "utf-8"), body[end + _LENGTH_BYTES :]
        content = unpack(self._path, kind, packed)
        if len(content) != index.uncompressed_size:
            raise ValueError("a chunk is not as long as its index states")
        if checksum not in (0, crc32(content)):
            raise ValueError("the checksum of a chunk is not that of its content")
        return content


def _records(data: bytes | memoryview) -> Iterator[tuple[int, memoryview]]:
    """The kind and content of each record.

    Raises:
        ValueError: if a kind is unknown, or the last record incomplete.
    """
    view, end = memoryview(data), 0
    while end < len(data):
        opcode, length = _HEAD.unpack_from(data, end)
        start, end = end + _HEAD.size, end + _HEAD.size + length
        if opcode not in _KNOWN:
            raise ValueError(f"a record of the unknown kind {opcode}")
        if end > len(data):
            raise ValueError("a record is incomplete")
        yield opcode, view[start:end]
