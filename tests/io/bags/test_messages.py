"""Messages of images and clouds, in any encoding and layout, are what was recorded."""

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


OPAQUE = np.dstack([BGR, np.full(GRAY.shape, 255, np.uint8)])
BRIGHT = GRAY.copy()
BRIGHT[0, 0] = 255  # what fixes the depth of 16 bits
MASK = np.ones(80, bool)
MASK[[0, 1, *range(37, 43), 78, 79]] = False  # where neighbours of a mosaic have another colour
COLOURS = np.zeros((60, 80, 3), np.uint8)
COLOURS[:, :40], COLOURS[:, 40:] = (200, 90, 30), (20, 140, 250)


def mosaic(channels: str) -> NDArray[np.uint8]:
    """Pixels of which each has one of BGR's channels: (0, 0), (0, 1), (1, 0), (1, 1)."""
    found = np.zeros((60, 80), np.uint8)
    for place, channel in enumerate(channels):
        pixels = np.s_[place // 2 :: 2, place % 2 :: 2]
        found[pixels] = COLOURS[pixels][..., int(channel)]
    return found


def packed(order: str) -> NDArray[np.uint8]:
    """Yuv of one colour, two pixels of which share u and v."""
    planar = cv2.cvtColor(np.full((8, 8, 3), (200, 90, 30), np.uint8), cv2.COLOR_BGR2YUV_I420)
    values = {"y": planar[0, 0], "u": planar[8, 0], "v": planar[11, 0]}
    pairs = [[values[order[0]], values[order[1]]], [values[order[2]], values[order[3]]]]
    return np.tile(np.uint8([pairs]), (6, 4, 1))


MOSAICS = {"rggb": "2110", "bggr": "0112", "gbrg": "1021", "grbg": "1201"}
YUV = {"uyvy": "uyvy", "yuv422": "uyvy", "yuy2": "yuyv", "yvyu": "yvyu", "yuyv": "yuyv",
       "YUV422_YUY2": "yuyv"}  # fmt: skip
PIXELS: list[tuple[str, NDArray[Any], NDArray[Any]]] = [
    ("bgr8", BGR, BGR), ("8UC3", BGR, BGR), ("rgb8", BGR[..., ::-1], BGR), ("bgra8", OPAQUE, BGR),
    ("rgba8", OPAQUE[..., [2, 1, 0, 3]], BGR), ("mono8", GRAY, np.dstack([GRAY] * 3)),
    *((encoding, BRIGHT.astype(np.uint16) << (bits - 8), np.dstack([BRIGHT] * 3))
      for encoding in ("mono16", "16UC1") for bits in (10, 12, 14, 16)),
    *((f"bayer_{pattern}{bits}", mosaic(channels).astype(f"u{bits // 8}") << (bits - 8), COLOURS)
      for pattern, channels in MOSAICS.items() for bits in (8, 16)),
    *((encoding, packed(order), np.full((6, 8, 3), (200, 90, 30))) for encoding, order in
      YUV.items()),
]  # fmt: skip


@pytest.mark.parametrize("layout", [{}, {"padding": 7}, {"big_endian": True}], ids=str)
@pytest.mark.parametrize("row", PIXELS, ids=lambda row: row[0])
def test_pixels_of_any_encoding_and_layout_give_their_colours_back(
    row: tuple[str, NDArray[Any], NDArray[Any]], layout: dict[str, Any]
) -> None:
    encoding, pixels, expected = row
    found = read(pixels, encoding, **layout)
    inner = np.s_[2:-2, MASK] if encoding.startswith("bayer") else np.s_[:]
    tolerance = 3 if encoding in YUV else 0
    np.testing.assert_allclose(found[inner], expected[inner], atol=tolerance)
    assert found.flags.writeable


JPEG = (SAMPLE / "cameras" / "left" / "000000.jpg").read_bytes()
WIDE = GRAY.astype(np.uint16) << 4
WIDE[0, 0] = 255 << 4


def png(image: NDArray[Any]) -> bytes:
    return bytes(cv2.imencode(".png", image)[1].tobytes())


@pytest.mark.parametrize(
    ("form", "data", "expected"),
    [
        *((form, JPEG, BGR) for form in ("jpeg", "bgr8; jpeg compressed bgr8",
                                         "rgb8; jpeg compressed bgr8")),
        ("png", png(BGR), BGR),
        ("rgb8; png compressed rgb8", png(BGR[..., ::-1]), BGR),
        ("mono16; png compressed ", png(WIDE), np.dstack([BRIGHT] * 3)),
        ("bayer_rggb8; png compressed ", png(mosaic(MOSAICS["rggb"])), COLOURS),
    ],
    ids=range(7),
)  # fmt: skip
def test_compressed_images_are_read_in_the_order_in_which_they_were_stored(
    form: str, data: bytes, expected: NDArray[Any]
) -> None:
    found = image_from_message(MAKE.compressed(data, form, START_NS), "here")
    inner = np.s_[2:-2, MASK] if "bayer" in form else np.s_[:]
    np.testing.assert_array_equal(found[inner], expected[inner])


def test_images_that_cannot_be_read_are_named() -> None:
    cut = MAKE.image(BGR, "bgr8", START_NS)
    cut.data = cut.data[:-1]
    with pytest.raises(DatasetError, match=r"here: has 691199 bytes for 640x360 px"):
        image_from_message(cut, "here")
    with pytest.raises(DatasetError, match="here: image encoding '32FC1' is unknown; known are m"):
        read(GRAY, "32FC1")
    with pytest.raises(DatasetError, match="here: is truncated"):
        image_from_message(MAKE.compressed(JPEG[:-100], "jpeg", START_NS), "here")
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
