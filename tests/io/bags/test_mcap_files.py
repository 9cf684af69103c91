"""MCAP files as recorders and editors leave them: every one is read, or what is wrong is true."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibgraph import FileError, load_dataset, load_rig
from calibgraph.io.bags.mcap_files import McapFile
from calibgraph.io.bags.messages import Bag
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    START_NS,
    STORES,
    Messages,
    Stamped,
    sample_messages,
    write_bag,
)

pytest.importorskip("mcap")

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
LATEST_NS = 2**63 - 1


def write_mcap(
    path: Path,
    messages: list[Stamped],
    *,
    kind: str = "mcap",
    profile: str = "ros2",
    beside: str = "",
    **options: Any,
) -> Path:
    """Messages of ROS 2, or 1, by the library mcap.

    Args:
        path: of the file.
        messages: in any order.
        kind: ros1, or mcap for those of ROS 2.
        profile: of the header.
        beside: the encoding of a further channel.
        options: of the writer.
    """
    ros1 = kind == "ros1"
    store = STORES[ros1]
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 200_000, **options})
        writer.start(profile, "test")
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
    for name, camera in expected.rig.cameras.items():
        T = data.rig.cameras[name].T_camera_lidar
        np.testing.assert_allclose(T, camera.T_camera_lidar, atol=1e-12)
    assert len(data.frames) == len(expected.frames)
    for found, frame in zip(data.frames[::5], expected.frames[::5], strict=True):
        np.testing.assert_array_equal(found.load_cloud(), frame.load_cloud())
        for name, camera in expected.rig.cameras.items():
            image = found.load_image(name, camera)
            np.testing.assert_array_equal(image, frame.load_image(name, camera))


@pytest.mark.parametrize("name", WHOLE)
def test_a_file_is_read_by_its_index(tmp_path: Path, name: str) -> None:
    messages = sample_messages(Messages("mcap"))
    require_the_sample(write_mcap(tmp_path / "drive.mcap", messages, **WHOLE[name]))


@pytest.mark.parametrize("name", NOT_WHOLE)
def test_a_file_whose_index_is_not_whole_is_named_with_the_repair(
    tmp_path: Path, name: str
) -> None:
    path = write_mcap(tmp_path / "drive.mcap", sample_messages(MAKE), **NOT_WHOLE[name])
    with pytest.raises(FileError, match=r"index is not whole .*; write one with `mcap recover d"):
        load_rig(path)


@pytest.mark.parametrize("name", ["whole", "no_message_index"])
def test_messages_come_by_time_and_only_those_asked_for(tmp_path: Path, name: str) -> None:
    messages = sample_messages(MAKE)
    shuffled = [messages[i] for i in np.random.default_rng(3).permutation(len(messages))]
    path = write_mcap(tmp_path / "drive.mcap", shuffled, **WHOLE[name])
    expected = sorted(each.record_ns for each in messages if each.topic == "/points")
    file = McapFile(path)
    found = [time_ns for _, time_ns, _ in file.messages(["/points"], 0, LATEST_NS)]
    assert found == expected
    assert [t for _, t, _ in file.messages(["/points"], expected[1], expected[4])] == expected[1:4]
    file.close()


@pytest.mark.parametrize(
    ("name", "encoding"),
    [("whole", "json"), ("whole", ""), ("no_message_index", "protobuf"), ("lz4", "flatbuffer")],
)
def test_channels_of_other_encodings_are_left_alone(
    tmp_path: Path, name: str, encoding: str
) -> None:
    messages = sample_messages(Messages("mcap"))
    path = write_mcap(tmp_path / "drive.mcap", messages, beside=encoding or "none", **WHOLE[name])
    require_the_sample(path)
    assert "/notes" in Bag(path).topics


def test_an_unknown_compression_is_named(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "drive.mcap", sample_messages(Messages("mcap")), enable_crcs=False)
    text = struct.pack("<I", 4)
    path.write_bytes(path.read_bytes().replace(text + b"zstd", text + b"bzip"))
    with pytest.raises(FileError, match="is compressed by 'bzip'; known are bz2, lz4 and zstd"):
        Bag(path).first("/points")


def test_a_damaged_chunk_is_noticed_by_its_sum(tmp_path: Path) -> None:
    path = write_mcap(
        tmp_path / "drive.mcap",
        sample_messages(Messages("mcap")),
        compression=CompressionType.NONE,
    )
    spoilt = bytearray(path.read_bytes())
    spoilt[len(spoilt) // 2] ^= 0x55
    path.write_bytes(bytes(spoilt))
    with pytest.raises(FileError, match="the checksum of a chunk is not"):
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
