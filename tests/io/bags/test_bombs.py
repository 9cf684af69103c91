"""Small bags that unpack to gigabytes, and databases that compute, end in one line and little."""

from __future__ import annotations

import bz2
import json
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from tests.io.bags.writing import KINDS, Messages, sample_messages, write_bag

pytest.importorskip("mcap")

import lz4.frame
import zstandard

MOST_S, MOST_MB = 2.0, 200
BOMB_BYTES = 2**31 - 2**20
BLOCK = bytes(2**20)


def zstd_bomb(size: int = BOMB_BYTES) -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    parts = [packer.compress(BLOCK) for _ in range(size // len(BLOCK))]
    return b"".join([*parts, packer.flush()])


def lz4_bomb() -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    begin = packer.begin()
    return b"".join([begin, *(packer.compress(BLOCK) for _ in range(170)), packer.flush()])


def bz2_bomb() -> bytes:
    packer = bz2.BZ2Compressor()
    return b"".join([*(packer.compress(BLOCK) for _ in range(200)), packer.flush()])


def mcap_bomb(folder: Path) -> Path:
    """One chunk of 2 GiB, as its index states."""
    return _mcap(folder, zstd_bomb(), BOMB_BYTES)


def mcap_liar(folder: Path) -> Path:
    """The same, of which the index states 1 MiB."""
    return _mcap(folder, zstd_bomb(), 2**20)


def _mcap(folder: Path, packed: bytes, stated: int) -> Path:
    def record(opcode: int, body: bytes) -> bytes:
        return struct.pack("<BQ", opcode, len(body)) + body

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    magic = b"\x89MCAP0\r\n"
    channel = struct.pack("<HH", 1, 0) + text("/points") + text("cdr") + struct.pack("<I", 0)
    chunk = record(
        6,
        struct.pack("<QQQI", 5, 6, stated, 0)
        + text("zstd")
        + struct.pack("<Q", len(packed))
        + packed,
    )  # noqa: E501
    start = len(magic) + len(head := record(1, text("") + text("")))
    index = struct.pack("<QQQQ", 5, 6, start, len(chunk)) + struct.pack("<IQ", 0, 0)
    index += text("zstd") + struct.pack("<QQ", len(packed), stated)
    counts = struct.pack("<IHQ", 10, 1, 1)
    statistics = struct.pack("<QHIIIIQQ", 1, 0, 1, 0, 0, 1, 5, 6) + counts
    data = magic + head + chunk
    footer = record(2, struct.pack("<QQI", len(data), 0, 0))
    summary = record(4, channel) + record(11, statistics) + record(8, index)
    path = folder / "bomb.mcap"
    path.write_bytes(data + summary + footer + magic)
    return path


def ros1_bomb(kind: str, packed: bytes) -> Callable[[Path], Path]:
    """A bag whose chunks are replaced by a bomb, as long as those were or a little longer."""

    def make(folder: Path) -> Path:
        path = write_bag(folder, "ros1", sample_messages(Messages("ros1")), compression=kind)
        data = path.read_bytes()
        mark = b"compression=" + kind.lower().encode()
        at = data.index(mark)
        size_at = data.index(b"size=", at) + len(b"size=") + 4
        (size,) = struct.unpack_from("<I", data, size_at)
        assert len(packed) <= size
        start = size_at + 4
        path.write_bytes(data[:start] + packed.ljust(size, b"\0") + data[start + size :])
        return path

    return make


def db3_bomb(folder: Path) -> Path:
    """A folder whose messages are compressed, one of them a bomb."""
    bag = write_bag(folder, "sqlite3", sample_messages(Messages("sqlite3")), compression="MESSAGE")
    with sqlite3.connect(next(bag.glob("*.db3"))) as database:
        database.execute("UPDATE messages SET data = ?", [zstd_bomb()])
    return bag


def file_bomb(folder: Path) -> Path:
    """A folder whose one file is a bomb."""
    bag = write_bag(folder, "sqlite3", sample_messages(Messages("sqlite3")), compression="FILE")
    next(bag.glob("*.zstd")).write_bytes(zstd_bomb())
    return bag


def computed(schema: str) -> Callable[[Path], Path]:
    """A database whose messages are not stored but computed."""

    def make(folder: Path) -> Path:
        path = folder / "bomb.db3"
        with sqlite3.connect(path) as database:
            database.executescript(
                "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
                "serialization_format TEXT);"
                "INSERT INTO topics VALUES (1, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr');"
                + schema
            )
        return path

    return make


ENDLESS = (
    "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) "
    "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n;"
)
GENERATED = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
    "data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL);"
    "INSERT INTO messages(topic_id, timestamp) VALUES (1, 1);"
)

BOMBS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "mcap": (mcap_bomb, "unpack to 2047 MiB or more, which no recording does"),
    "mcap whose index states less": (mcap_liar, "unpack to more than 64 MiB, which no recording"),
    "lz4": (ros1_bomb("LZ4", lz4_bomb()), "MiB, which no recording does"),
    "bz2": (ros1_bomb("BZ2", bz2_bomb()), "MiB, which no recording does"),
    "messages": (db3_bomb, "unpack to more than 64 MiB, which no recording does"),
    "file": (file_bomb, "MiB or more, which no recording does"),
    "endless view": (computed(ENDLESS), "it has no tables messages and topics"),
    "computed data": (computed(GENERATED), "string or blob too big"),
}
READ = """
import json, resource, sys, time
from pathlib import Path
from calibgraph.errors import CalibrationError
from calibgraph.io.bags.messages import Bag, type_store
import zstandard, lz4.frame, rosbags.rosbag1, mcap.records, bz2
type_store(ros1=True), type_store(ros1=False)
before, start, text = resource.getrusage(resource.RUSAGE_SELF), time.process_time(), "read"
try:
    bag = Bag(Path(sys.argv[1]))
    for _ in bag.messages([*bag.topics]):
        pass
except CalibrationError as error:
    text = str(error)
after = resource.getrusage(resource.RUSAGE_SELF)
print(json.dumps([text, time.process_time() - start, (after.ru_maxrss - before.ru_maxrss) / 1024]))
"""


@pytest.mark.parametrize("name", BOMBS)
def test_a_bomb_is_one_line_in_little_time_and_memory(tmp_path: Path, name: str) -> None:
    make, expected = BOMBS[name]
    path = make(tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", READ, path], capture_output=True, text=True, check=True, timeout=60
    )
    line, taken_s, grown_mb = json.loads(done.stdout)
    assert expected in line and "\n" not in line and str(tmp_path) in line
    assert taken_s < MOST_S and grown_mb < MOST_MB


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("folder", ["drive #1", "run%203", "what?", "a'b;c&d", "50%"])
def test_a_bag_is_read_whatever_its_folder_is_called(
    tmp_path: Path, kind: str, folder: str
) -> None:
    from calibgraph.io.bags.messages import Bag

    other = write_bag(tmp_path / "run 3", kind, []).parent
    made = write_bag(tmp_path / "one", kind, sample_messages(Messages(kind)))
    bag = made.parent.rename(tmp_path / folder) / made.name
    other = other / made.name
    assert Bag(bag).topics["/points"].count == 6
    assert not Bag(other).topics
    if bag.is_dir():
        named = yaml.safe_load((bag / "metadata.yaml").read_text())
        (file,) = named["rosbag2_bagfile_information"]["relative_file_paths"]
        assert Bag(bag / file).topics["/points"].count == 6
