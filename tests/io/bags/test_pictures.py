"""Image messages of any encoding are the image that was recorded."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph import DatasetError
from calibgraph.io.bags.pictures import is_depth, picture_of
from tests.conftest import SAMPLE
from tests.io.bags.writing import START_NS, Messages

BGR = np.asarray(cv2.imread(str(SAMPLE / "cameras" / "left" / "000000.jpg")))
GRAY = cv2.cvtColor(BGR, cv2.COLOR_BGR2GRAY)
MAKE = Messages("mcap")


def read(pixels: NDArray[Any], encoding: str, **layout: Any) -> NDArray[np.uint8]:
    return picture_of(MAKE.image(pixels, encoding, START_NS, **layout), "here")


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


def test_yuv_is_read() -> None:
    gray = np.full((40, 60), 117, np.uint8)
    neutral = np.full_like(gray, 128)
    for encoding, layers in (("yuv422", (neutral, gray)), ("yuv422_yuy2", (gray, neutral))):
        found = read(np.dstack(layers), encoding).astype(int)
        assert np.ptp(found) == 0  # one gray, by the scale of video
        assert abs(found[0, 0, 0] - (117 - 16) * 255 / 219) <= 1


@pytest.mark.parametrize("counts_both", [False, True])
@pytest.mark.parametrize("encoding", ["nv12", "nv21", "nv24", "nv42", "NV12"])
@pytest.mark.parametrize("padding", [0, 64])
def test_a_gray_and_a_colour_plane_are_the_image_of_the_camera(
    encoding: str, padding: int, counts_both: bool
) -> None:
    colours = np.kron(BGR[::8, ::8], np.ones((8, 8, 1), np.uint8))  # no edge between subsamples
    height, width = colours.shape[:2]
    planar = cv2.cvtColor(colours, cv2.COLOR_BGR2YUV_I420).ravel()
    gray, u, v = np.split(planar, [height * width, height * width * 5 // 4])
    pairs = np.dstack([u, v] if encoding.lower() in ("nv12", "nv24") else [v, u])
    pairs = pairs.reshape(height // 2, width // 2, 2)
    if encoding.endswith(("24", "42")):
        pairs = pairs.repeat(2, axis=0).repeat(2, axis=1)
    lines = [np.pad(plane, ((0, 0), (0, padding * plane.shape[1] // width))).ravel()
             for plane in (gray.reshape(height, width), pairs.reshape(len(pairs), -1))]  # fmt: skip
    message = MAKE.image(gray.reshape(height, width), encoding, START_NS)
    message.data, message.step = np.concatenate(lines), width + padding
    if counts_both:
        message.height = len(message.data) // message.step
    found = picture_of(message, "here")
    assert found.shape == colours.shape
    # the 8 bits of YUV are coarser than those of BGR by 255 / 219 and up to 2.02 for blue
    np.testing.assert_allclose(found.astype(int), colours, atol=4)
    message.data = message.data[: -message.step]
    with pytest.raises(DatasetError, match=f"px, encoding '{encoding}'; record it again"):
        picture_of(message, "here")


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("uyvy", "uy"), ("yuy2", "yu"), ("yvyu", "yv"), ("yuyv", "yu"), ("YUV422_YUY2", "yu")],
)
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
    np.testing.assert_array_equal(picture_of(MAKE.compressed(data, form, START_NS), "here"), BGR)


def png(image: NDArray[Any], form: str) -> NDArray[np.uint8]:
    data = cv2.imencode(".png", image)[1].tobytes()
    return picture_of(MAKE.compressed(data, form, START_NS), "here")


def test_png_is_read_in_the_order_in_which_it_was_stored() -> None:
    np.testing.assert_array_equal(png(BGR, "png"), BGR)
    np.testing.assert_array_equal(png(BGR[..., ::-1], "rgb8; png compressed rgb8"), BGR)
    wide = GRAY.astype(np.uint16) << 4
    wide[0, 0] = 0xFFF
    np.testing.assert_array_equal(png(wide, "mono16; png compressed ")[1:, :, 0], GRAY[1:])


def test_images_that_cannot_be_read_are_named() -> None:
    cut = MAKE.image(BGR, "bgr8", START_NS)
    cut.data = cut.data[:-1]
    with pytest.raises(DatasetError, match=r"here: has 691199 bytes for 640x360 px"):
        picture_of(cut, "here")
    with pytest.raises(DatasetError, match="here: image encoding '32FC1' is unknown; known are m"):
        read(GRAY, "32FC1")
    data = (SAMPLE / "cameras" / "left" / "000000.jpg").read_bytes()
    with pytest.raises(DatasetError, match="here: is truncated"):
        picture_of(MAKE.compressed(data[:-100], "jpeg", START_NS), "here")
    with pytest.raises(DatasetError, match="its format 'h264' is neither JPEG nor PNG"):
        picture_of(MAKE.compressed(b"\0\0\0\1g", "h264", START_NS), "here")


def test_depth_is_no_image() -> None:
    assert is_depth(MAKE.image(GRAY.astype(np.uint16), "16UC1", START_NS))
    assert is_depth(MAKE.compressed(b"", "16UC1; compressedDepth png", START_NS))
    assert not is_depth(MAKE.image(GRAY.astype(np.uint16), "mono16", START_NS))
    assert not is_depth(MAKE.compressed(b"", "bgr8; jpeg compressed bgr8", START_NS))
