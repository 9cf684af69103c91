"""Messages of images and clouds, in any encoding and layout, are what was recorded."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from calibgraph import DatasetError, load_dataset
from calibgraph.io.bags.messages import LIVOX_CLOUDS, read_custom_msg
from calibgraph.io.bags.pictures import image_from_message, is_depth
from calibgraph.io.bags.point_clouds import cloud_from_message, has_points
from calibgraph.io.clouds import time_fields
from tests.conftest import SAMPLE
from tests.io.bags.writing import (
    KINDS,
    START_NS,
    STORES,
    Messages,
    Stamped,
    sample_messages,
    structured,
    without,
    write_bag,
)
from tests.io.test_clouds import expected_of, layouts, often

BGR = np.asarray(cv2.imread(str(SAMPLE / "cameras" / "left" / "000000.jpg")))
GRAY = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
MAKE = Messages("mcap")


def read(pixels: NDArray[Any], encoding: str, **layout: Any) -> NDArray[np.uint8]:
    return image_from_message(MAKE.image(pixels, encoding, START_NS, **layout), "here")


def test_colours_are_read_in_their_order() -> None:
    opaque = np.dstack([BGR, np.full(GRAY.shape, 255, np.uint8)])
    np.testing.assert_array_equal(read(BGR, "bgr8"), BGR)
    np.testing.assert_array_equal(read(BGR, "8UC3"), BGR)
    np.testing.assert_array_equal(read(BGR[..., ::-1], "rgb8"), BGR)
    np.testing.assert_array_equal(read(opaque, "bgra8"), BGR)
    np.testing.assert_array_equal(read(opaque[..., [2, 1, 0, 3]], "rgba8"), BGR)
    np.testing.assert_array_equal(read(GRAY, "mono8"), np.dstack([GRAY] * 3))


def test_padded_rows_are_cut_off_and_the_image_can_be_drawn_on() -> None:
    found = read(BGR, "bgr8", padding=7)
    np.testing.assert_array_equal(found, BGR)
    assert found.flags.writeable
    assert read(BGR, "bgr8").flags.writeable


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_the_used_bits_of_16_are_kept(bits: int, big_endian: bool) -> None:
    bright = GRAY.copy()
    bright[0, 0] = 255  # what fixes the depth
    wide = bright.astype(np.uint16) << (bits - 8)
    for encoding in ("mono16", "16UC1"):
        found = read(wide, encoding, big_endian=big_endian)
        np.testing.assert_array_equal(found, np.dstack([bright] * 3))


@pytest.mark.parametrize(
    ("pattern", "channels"),  # BGR's channel at (0, 0), (0, 1), (1, 0), (1, 1)
    [
        ("rggb", (2, 1, 1, 0)),
        ("bggr", (0, 1, 1, 2)),
        ("gbrg", (1, 0, 2, 1)),
        ("grbg", (1, 2, 0, 1)),
    ],
)
@pytest.mark.parametrize("wide", [False, True])
def test_mosaics_give_their_colours_back(
    pattern: str, channels: tuple[int, int, int, int], wide: bool
) -> None:
    colours = np.zeros((60, 80, 3), np.uint8)
    colours[:, :40], colours[:, 40:] = (200, 90, 30), (20, 140, 250)
    mosaic = np.zeros((60, 80), np.uint8)
    for (row, column), channel in zip(((0, 0), (0, 1), (1, 0), (1, 1)), channels, strict=True):
        mosaic[row::2, column::2] = colours[row::2, column::2, channel]
    if wide:
        found = read(mosaic.astype(np.uint16) << 8, f"bayer_{pattern}16")
    else:
        found = read(mosaic, f"bayer_{pattern}8")
    inner = np.ones(80, bool)
    inner[[0, 1, *range(37, 43), 78, 79]] = False  # where neighbours have another colour
    np.testing.assert_array_equal(found[2:-2, inner], colours[2:-2, inner])


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("uyvy", "uy"), ("yuv422", "uy"), ("yuy2", "yu"), ("yvyu", "yv"), ("yuyv", "yu"),
     ("YUV422_YUY2", "yu")],
)  # fmt: skip
def test_colours_of_packed_yuv_are_in_their_places(encoding: str, order: str) -> None:
    planar = cv2.cvtColor(np.full((8, 8, 3), (200, 90, 30), np.uint8), cv2.COLOR_BGR2YUV_I420)
    y, u, v = planar[0, 0], planar[8, 0], planar[11, 0]
    first, second = (u, v) if "u" in order else (v, u)
    pairs = [(first, y), (second, y)] if order[0] != "y" else [(y, first), (y, second)]
    found = read(np.tile(np.uint8([pairs]), (6, 4, 1)), encoding)
    np.testing.assert_allclose(found, np.full((6, 8, 3), (200, 90, 30)), atol=3)


@pytest.mark.parametrize(
    "form", ["jpeg", "bgr8; jpeg compressed bgr8", "rgb8; jpeg compressed bgr8"]
)
def test_jpeg_is_read(form: str) -> None:
    data = (SAMPLE / "cameras" / "left" / "000000.jpg").read_bytes()
    np.testing.assert_array_equal(
        image_from_message(MAKE.compressed(data, form, START_NS), "here"), BGR
    )


def png(image: NDArray[Any], form: str) -> NDArray[np.uint8]:
    data = cv2.imencode(".png", image)[1].tobytes()
    return image_from_message(MAKE.compressed(data, form, START_NS), "here")


def test_png_is_read_in_the_order_in_which_it_was_stored() -> None:
    np.testing.assert_array_equal(png(BGR, "png"), BGR)
    np.testing.assert_array_equal(png(BGR[..., ::-1], "rgb8; png compressed rgb8"), BGR)
    wide = GRAY.astype(np.uint16) << 4
    wide[0, 0] = 0xFFF
    np.testing.assert_array_equal(png(wide, "mono16; png compressed ")[1:, :, 0], GRAY[1:])


def test_a_compressed_mosaic_gives_its_colours_back() -> None:
    mosaic = np.tile(np.uint8([[30, 90], [90, 200]]), (20, 30))
    found = png(mosaic, "bayer_rggb8; png compressed ")
    np.testing.assert_array_equal(found[2:-2, 2:-2], np.full((36, 56, 3), (200, 90, 30)))


def test_images_that_cannot_be_read_are_named() -> None:
    cut = MAKE.image(BGR, "bgr8", START_NS)
    cut.data = cut.data[:-1]
    with pytest.raises(DatasetError, match=r"here: has 691199 bytes for 640x360 px"):
        image_from_message(cut, "here")
    with pytest.raises(DatasetError, match="here: image encoding '32FC1' is unknown; known are m"):
        read(GRAY, "32FC1")
    data = (SAMPLE / "cameras" / "left" / "000000.jpg").read_bytes()
    with pytest.raises(DatasetError, match="here: is truncated"):
        image_from_message(MAKE.compressed(data[:-100], "jpeg", START_NS), "here")
    with pytest.raises(DatasetError, match="its format 'h264' is neither JPEG nor PNG"):
        image_from_message(MAKE.compressed(b"\0\0\0\1g", "h264", START_NS), "here")


def test_depth_is_no_image() -> None:
    assert is_depth(MAKE.image(GRAY.astype(np.uint16), "16UC1", START_NS))
    assert is_depth(MAKE.compressed(b"", "16UC1; compressedDepth png", START_NS))
    assert not is_depth(MAKE.image(GRAY.astype(np.uint16), "mono16", START_NS))
    assert not is_depth(MAKE.compressed(b"", "bgr8; jpeg compressed bgr8", START_NS))


CLOUD = np.random.default_rng(3).normal(0.0, 20.0, (120, 4)).astype(np.float32)


@often
@given(rows=layouts(padding=False), order=st.sampled_from("<>"), padding=st.integers(0, 5))
def test_clouds_of_any_fields_and_byte_order_are_read(
    rows: NDArray[np.void], order: str, padding: int
) -> None:
    given_rows = rows.astype(rows.dtype.newbyteorder(order))  # type: ignore[call-overload]
    message = MAKE.cloud(given_rows, START_NS, padding=padding)
    np.testing.assert_array_equal(cloud_from_message(message, "here"), expected_of(rows))


def test_organised_clouds_with_padded_rows_are_read() -> None:
    message = MAKE.cloud(structured(CLOUD), START_NS, height=6, padding=5)
    assert (message.height, message.width, message.row_step) == (6, 20, 20 * 16 + 5)
    np.testing.assert_array_equal(cloud_from_message(message, "here"), CLOUD)


def test_points_without_a_return_are_left_out() -> None:
    cloud = CLOUD.copy()
    cloud[3, :3] = np.nan
    cloud[5, 1] = np.nan
    cloud[8, 0] = np.inf
    cloud[20, :3] = 0.0
    found = cloud_from_message(MAKE.cloud(structured(cloud), START_NS, height=4), "here")
    np.testing.assert_array_equal(found, np.delete(CLOUD, [3, 5, 8, 20], axis=0))


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_scan_that_sees_nothing_has_no_points(value: float) -> None:
    assert not has_points(MAKE.cloud(structured(np.full_like(CLOUD, value)), START_NS), "here")
    assert not has_points(MAKE.cloud(structured(CLOUD[:0]), START_NS), "here")
    assert has_points(MAKE.cloud(structured(CLOUD), START_NS), "here")


def test_clouds_without_coordinates_or_cut_short_are_named() -> None:
    with pytest.raises(DatasetError, match=r"here: its fields x, y, intensity have no x y z"):
        cloud_from_message(MAKE.cloud(structured(CLOUD, "xyi"), START_NS), "here")
    message = MAKE.cloud(structured(CLOUD), START_NS)
    message.data = message.data[:-1]
    with pytest.raises(DatasetError, match=r"has 1919 bytes for 120 x 1 points of 16 bytes"):
        cloud_from_message(message, "here")


POINT = (
    "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
)
DEFINITION = (
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
                store.register({**point, **get_types_from_msg(DEFINITION, name)})


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
        found = read_custom_msg(data, ros1=ros1)
        assert (found.header.frame_id, found.header.stamp.sec) == (frame, 5)
        assert found.header.stamp.nanosec == 12
        np.testing.assert_array_equal(cloud_from_message(found, "here")[:, :3], cloud[:count, :3])
        assert time_fields(each.name for each in found.fields) == ["offset_time"]


def test_a_truncated_cloud_is_refused() -> None:
    make = Messages("mcap")
    message = custom_msg(make, np.ones((9, 4), np.float32), 0, LIVOX_CLOUDS[0])
    data = bytes(STORES[False].serialize_cdr(message, LIVOX_CLOUDS[0]))
    for length in (len(data) - 30, 40, 10, 3):
        with pytest.raises((ValueError, IndexError, struct.error)):
            read_custom_msg(data[:length], ros1=False)
