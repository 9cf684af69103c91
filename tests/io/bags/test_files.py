"""Files of bags: whole, damaged, of other recorders, and bombs; every one is read or one line."""

import builtins
import bz2
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

from calibgraph import CalibrationError, FileError, load_dataset, load_rig
from calibgraph.io.bags import load_bag_cloud, load_bag_image
from calibgraph.io.bags.messages import Bag
from tests.conftest import SAMPLE, require_poses
from tests.io.bags.writing import (
    KINDS,
    START_NS,
    STORES,
    Messages,
    Stamped,
    require_same_frames,
    sample_bag,
    sample_messages,
    write_bag,
)

pytest.importorskip("mcap")

import lz4.frame
import zstandard
from mcap.writer import CompressionType, IndexType, Writer

MAKE = Messages("mcap")

WHOLE: dict[str, dict[str, Any]] = {
    "whole": {},
    "no_message_index": {"index_types": IndexType.CHUNK},
    "lz4": {"compression": CompressionType.LZ4},
    "not_compressed": {"compression": CompressionType.NONE},
}
NOT_WHOLE: dict[str, dict[str, Any]] = {
    "no_chunk_index": {"index_types": IndexType.MESSAGE},
    "no_statistics": {"use_statistics": False},
    "neither": {"use_statistics": False, "index_types": IndexType.NONE},
    "channels_not_repeated": {"repeat_channels": False, "repeat_schemas": False},
    "schemas_not_repeated": {"repeat_schemas": False},
    "no_chunks": {"use_chunking": False},
    "no_chunks_no_statistics": {"use_chunking": False, "use_statistics": False},
}


def write_mcap(
    path: Path,
    messages: list[Stamped],
    *,
    kind: str = "mcap",
    beside: str = "",
    **options: Any,
) -> Path:
    """Messages of ROS 2, or 1, by the library mcap.

    Args:
        path: of the file.
        messages: in any order.
        kind: ros1, or mcap for those of ROS 2.
        beside: the encoding of a further channel.
        options: of the writer.
    """
    ros1 = kind == "ros1"
    store = STORES[ros1]
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 200_000, **options})
        writer.start("ros2", "test")
        if beside:
            number = writer.register_schema("foxglove.Notes", f"{beside}schema", b"{}")
            notes = writer.register_channel("/notes", beside, number)
            writer.add_message(notes, START_NS, b"\n", START_NS)
        channels: dict[str, int] = {}
        for each in messages:
            if each.topic not in channels:
                name = each.type.replace("/msg/", "/") if ros1 else each.type
                text = store.generate_msgdef(each.type, ros_version=1 if ros1 else 2)[0]
                number = writer.register_schema(
                    name, "ros1msg" if ros1 else "ros2msg", text.encode()
                )
                encoding = "ros1" if ros1 else "cdr"
                channels[each.topic] = writer.register_channel(each.topic, encoding, number)
            serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
            data = bytes(serialize(each.content, each.type))
            writer.add_message(channels[each.topic], each.record_ns, data, each.record_ns)
        writer.finish()
    return path


def require_the_sample(path: Path) -> None:
    """Check that a bag has the frames and the rig of the sample."""
    data, expected = load_dataset(path), load_dataset(SAMPLE)
    require_poses(data.rig.T_camera_lidar, expected.rig.T_camera_lidar, atol=1e-12)
    require_same_frames(data.select("::5"), expected.select("::5"))


@pytest.mark.parametrize("name", NOT_WHOLE)
def test_a_file_whose_index_is_not_whole_is_named_with_the_repair(
    tmp_path: Path, name: str
) -> None:
    path = write_mcap(tmp_path / "drive.mcap", sample_messages(MAKE), **NOT_WHOLE[name])
    with pytest.raises(FileError, match=r"index is not whole .*; write one with `mcap recover "):
        load_rig(path)


@pytest.mark.parametrize(
    ("name", "beside"),
    [("whole", ""), ("whole", "json"), ("no_message_index", "protobuf"), ("lz4", "flatbuffer"),
     ("not_compressed", "none")],
)  # fmt: skip
def test_a_file_is_read_by_its_index_and_channels_of_other_encodings_are_left_alone(
    tmp_path: Path, name: str, beside: str
) -> None:
    messages = sample_messages(Messages("mcap"))
    path = write_mcap(tmp_path / "drive.mcap", messages, beside=beside, **WHOLE[name])
    require_the_sample(path)
    assert ("/notes" in Bag(path).topics) == bool(beside)


def test_an_unknown_compression_is_named(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "drive.mcap", sample_messages(Messages("mcap")), enable_crcs=False)
    text = struct.pack("<I", 4)
    path.write_bytes(path.read_bytes().replace(text + b"zstd", text + b"bzip"))
    with pytest.raises(FileError, match="is compressed by 'bzip'; known are bz2, lz4 and zstd"):
        Bag(path).first("/points")


def test_a_damaged_chunk_is_noticed_by_its_sum(tmp_path: Path) -> None:
    path = write_mcap(
        tmp_path / "drive.mcap", sample_messages(Messages("mcap")), compression=CompressionType.NONE
    )
    spoilt = bytearray(path.read_bytes())
    spoilt[len(spoilt) // 2] ^= 0x55
    path.write_bytes(bytes(spoilt))
    with pytest.raises(FileError, match="crc"):
        for frame in load_dataset(path).frames:
            frame.load_cloud()


def test_two_files_of_a_folder_are_one_recording(tmp_path: Path) -> None:
    messages = sample_messages(Messages("mcap"))
    bag = write_bag(tmp_path, "mcap", messages)
    half = START_NS + 250_000_000
    (bag / "drive_mcap.mcap").unlink()
    write_mcap(bag / "b_0.mcap", [each for each in messages if each.record_ns < half])
    later = [each for each in messages if each.record_ns >= half]
    write_mcap(bag / "a_1.mcap", later, index_types=IndexType.CHUNK)
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] = ["a_1.mcap", "b_0.mcap"]
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    require_the_sample(bag)
    assert Bag(bag).topics["/points"].count == 6


def data_file(bag: Path) -> Path:
    return bag if bag.is_file() else next(bag.glob("*.[dm][bc]*"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_a_truncated_bag_is_named(tmp_path: Path, kind: str, share: float) -> None:
    bag = sample_bag(tmp_path, kind)
    path = data_file(bag)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(FileError, match=r"is truncated, was not closed or is no ROS bag") as caught:
        load_dataset(bag, load_rig(SAMPLE))
    assert str(caught.value).startswith(str(bag))
    assert "or repair it with `" in str(caught.value)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_that_are_gone_are_named(tmp_path: Path, kind: str) -> None:
    bag = sample_bag(tmp_path, kind)
    frame = load_dataset(bag).frames[0]
    for name in ("17-0.message", "text.message"):
        with pytest.raises(FileError, match=r"has no message of /points|no such message"):
            load_bag_cloud(frame.cloud_path.with_name(name))
    with pytest.raises(FileError, match="has no message of /elsewhere"):
        load_bag_cloud(bag / "elsewhere" / "17-0.message")
    moved = tmp_path / "moved" / frame.image_paths["left"].relative_to(tmp_path)
    with pytest.raises(FileError, match="no such message: its bag is not there"):
        load_bag_image(moved)


@pytest.mark.parametrize("library", ["rosbags", "mcap"])
def test_without_a_library_the_command_that_installs_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str
) -> None:
    bag = sample_bag(tmp_path, "mcap")
    imports: Callable[..., Any] = builtins.__import__

    def without_library(name: str, *rest: Any) -> Any:
        if name.partition(".")[0] == library:
            raise ImportError(f"No module named {name!r}")
        return imports(name, *rest)

    monkeypatch.delitem(sys.modules, "calibgraph.io.bags.files", raising=False)
    monkeypatch.setattr(builtins, "__import__", without_library)
    with pytest.raises(CalibrationError, match=r"needs rosbags and mcap: pip install 'calibgraph"):
        load_rig(bag)


MOST_S, MOST_MB = 2.0, 200
BOMB_BYTES = 2**31 - 2**20
BLOCK = bytes(2**20)


@cache
def zstd_bomb() -> bytes:
    packer = zstandard.ZstdCompressor().compressobj()
    parts = [packer.compress(BLOCK) for _ in range(BOMB_BYTES // len(BLOCK))]
    return b"".join([*parts, packer.flush()])


def lz4_bomb() -> bytes:
    packer = lz4.frame.LZ4FrameCompressor()
    begin = packer.begin()
    return b"".join([begin, *(packer.compress(BLOCK) for _ in range(170)), packer.flush()])


def bz2_bomb() -> bytes:
    packer = bz2.BZ2Compressor()
    return b"".join([*(packer.compress(BLOCK) for _ in range(200)), packer.flush()])


def mcap_bomb(stated: int) -> Callable[[Path], Path]:
    """A file with one chunk of 2 GiB, of which its index states a size."""
    return lambda folder: _mcap(folder, zstd_bomb(), stated)


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


def ros1_bomb(kind: str, pack: Callable[[], bytes]) -> Callable[[Path], Path]:
    """A bag whose chunks are replaced by a bomb, as long as those were or a little longer."""

    def make(folder: Path) -> Path:
        path = write_bag(folder, "ros1", sample_messages(Messages("ros1")), compression=kind)
        data = path.read_bytes()
        mark = b"compression=" + kind.lower().encode()
        at = data.index(mark)
        size_at = data.index(b"size=", at) + len(b"size=") + 4
        (size,) = struct.unpack_from("<I", data, size_at)
        packed = pack()
        assert len(packed) <= size
        start = size_at + 4
        path.write_bytes(data[:start] + packed.ljust(size, b"\0") + data[start + size :])
        return path

    return make


def db3_bomb(folder: Path) -> Path:
    """A folder whose messages are compressed, one of them a bomb."""
    bag = write_bag(folder, "sqlite3", sample_messages(Messages("sqlite3")), compression="MESSAGE")
    with closing(sqlite3.connect(next(bag.glob("*.db3")))) as database, database:
        database.execute("UPDATE messages SET data = ?", [zstd_bomb()])
    return bag


def computed(schema: str) -> Callable[[Path], Path]:
    """A database whose messages are not stored but computed."""

    def make(folder: Path) -> Path:
        path = folder / "bomb.db3"
        with closing(sqlite3.connect(path)) as database, database:
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
    "mcap": (mcap_bomb(BOMB_BYTES), "unpack to 2047 MiB or more, which no recording does"),
    "mcap whose index states less": (
        mcap_bomb(2**20),
        "is truncated, was not closed or is no ROS bag",
    ),
    "lz4": (ros1_bomb("LZ4", lz4_bomb), "MiB, which no recording does"),
    "bz2": (ros1_bomb("BZ2", bz2_bomb), "MiB, which no recording does"),
    "messages": (db3_bomb, "unpack to more than 64 MiB, which no recording does"),
    "endless view": (computed(ENDLESS), "it has no tables messages and topics"),
    "computed data": (computed(GENERATED), "string or blob too big"),
}
READ = """
import resource, sys, time
from pathlib import Path
from calibgraph.errors import CalibrationError
from calibgraph.io.bags.messages import Bag, type_store
import zstandard, lz4.frame, rosbags.rosbag1, mcap.records, bz2
type_store(ros1=True), type_store(ros1=False)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[1:]:
    start, text = time.process_time(), "read"
    try:
        bag = Bag(Path(path))
        for _ in bag.messages([*bag.topics]):
            pass
    except CalibrationError as error:
        text = str(error)
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(time.process_time() - start, grown_mb, text)
"""


@pytest.mark.ci
@pytest.mark.slow
def test_a_bomb_is_one_line_in_little_time_and_memory(tmp_path: Path) -> None:
    paths = []
    for name, (make, _) in BOMBS.items():
        (folder := tmp_path / name).mkdir()
        paths.append(make(folder))
    command = [sys.executable, "-c", READ, *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    for (name, (_, expected)), line in zip(BOMBS.items(), done.stdout.splitlines(), strict=True):
        taken_s, grown_mb, text = line.split(maxsplit=2)
        assert expected in text and str(tmp_path) in text, name
        assert float(taken_s) < MOST_S and float(grown_mb) < MOST_MB, name


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("folder", ["drive #1", "run%203", "what?", "a'b;c&d", "50%"])
def test_a_bag_is_read_whatever_its_folder_is_called(
    tmp_path: Path, kind: str, folder: str
) -> None:
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
