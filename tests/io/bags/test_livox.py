"""Clouds of Livox drivers, as their messages are defined and rosbags writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import load_dataset
from calibgraph.io.bags.messages import LIVOX_CLOUDS, read_custom_msg
from calibgraph.io.bags.point_clouds import points_of, time_fields
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    KINDS,
    STORES,
    Messages,
    Stamped,
    sample_messages,
    without,
    write_bag,
)

POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
)
CLOUD = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points"
)


@pytest.fixture(scope="module", autouse=True)
def definitions() -> None:
    """The drivers' messages, in the stores that the tests write with."""
    from rosbags.typesys import get_types_from_msg

    for store in STORES.values():
        for name in LIVOX_CLOUDS:
            if name not in store.fielddefs:
                point = get_types_from_msg(POINT, name.replace("CustomMsg", "CustomPoint"))
                store.register({**point, **get_types_from_msg(CLOUD, name)})


def custom_msg(make: Messages, cloud: np.ndarray, stamp_ns: int, name: str) -> Any:
    points = [
        make.make(
            name.replace("CustomMsg", "CustomPoint"), offset_time=1000 * number, x=x, y=y, z=z,
            reflectivity=int(200 * intensity), tag=16, line=number % 4,
        )
        for number, (x, y, z, intensity) in enumerate(cloud.tolist())
    ]  # fmt: skip
    return make.make(
        name, header=make.header(stamp_ns, "livox_frame"), timebase=stamp_ns,
        point_num=len(points), lidar_id=1, rsvd=np.zeros(3, np.uint8), points=points,
    )  # fmt: skip


@pytest.mark.parametrize("name", LIVOX_CLOUDS)
@pytest.mark.parametrize("kind", KINDS)
def test_frames_of_a_livox_are_read_from_a_bag(tmp_path: Path, kind: str, name: str) -> None:
    make, data = Messages(kind), load_dataset(SAMPLE, frames="0:2")
    messages = without(sample_messages(make, data), "/points")
    clouds = [frame.load_cloud()[:500] for frame in data.frames]
    for number, cloud in enumerate(clouds):
        stamp_ns = messages[0].record_ns + number * 100_000_000
        content = custom_msg(make, cloud, stamp_ns, name)
        messages.append(Stamped("/livox/lidar", name, stamp_ns, content))
    messages.sort(key=lambda each: each.record_ns)
    found = load_dataset(write_bag(tmp_path, kind, messages), data.rig)
    assert len(found.frames) == 2
    for frame, cloud in zip(found.frames, clouds, strict=True):
        read = frame.load_cloud()
        np.testing.assert_array_equal(read[:, :3], cloud[:, :3])
        np.testing.assert_array_equal(read[:, 3], (200 * cloud[:, 3].astype(float)).astype(int))
    assert "points have a offset_time" in found.notes[0]


@pytest.mark.parametrize("frame", ["", "a", "abcdefg", "livox_frame"])
@pytest.mark.parametrize("ros1", [True, False])
@pytest.mark.parametrize("little", [True, False])
def test_any_alignment_of_the_points_is_read(frame: str, ros1: bool, little: bool) -> None:
    if ros1 and not little:
        return  # ROS 1 has one byte order
    make = Messages("ros1" if ros1 else "mcap")
    cloud = np.random.default_rng(5).uniform(0.1, 1, (7, 4)).astype(np.float32)
    for count in (7, 1, 0):
        message = custom_msg(make, cloud[:count], 5_000_000_012, LIVOX_CLOUDS[1])
        message.header.frame_id = frame
        store = STORES[ros1]
        if ros1:
            data = bytes(store.serialize_ros1(message, LIVOX_CLOUDS[1]))
        else:
            data = bytes(store.serialize_cdr(message, LIVOX_CLOUDS[1], little_endian=little))
        found = read_custom_msg(data, store.types, ros1=ros1)
        assert (found.header.frame_id, found.header.stamp.sec) == (frame, 5)
        assert found.header.stamp.nanosec == 12
        np.testing.assert_array_equal(points_of(found, "here")[:, :3], cloud[:count, :3])
        assert time_fields(each.name for each in found.fields) == ["offset_time"]


def test_a_truncated_cloud_is_refused() -> None:
    make = Messages("mcap")
    message = custom_msg(make, np.ones((9, 4), np.float32), 0, LIVOX_CLOUDS[0])
    data = bytes(STORES[False].serialize_cdr(message, LIVOX_CLOUDS[0]))
    for length in (len(data) - 30, 40, 10, 3):
        with pytest.raises((ValueError, IndexError)):
            read_custom_msg(data[:length], STORES[False].types, ros1=False)
