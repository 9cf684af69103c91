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


def test_a_compressed_mosaic_gives_its_colours_back() -> None:
    mosaic = np.tile(np.uint8([[30, 90], [90, 200]]), (20, 30))
    found = png(mosaic, "bayer_rggb8; png compressed ")
    np.testing.assert_array_equal(found[2:-2, 2:-2], np.full((36, 56, 3), (200, 90, 30)))


def test_images_that_cannot_be_read_are_named() -> None:
    cut = MAKE.image(BGR, "bgr8", START_NS)
    cut.data = cut.data[:-1]
    with pytest.raises(DatasetError, match=r"here: has 691199 bytes for 640x360 px"):
        picture_of(cut, "here")
    with pytest.raises(DatasetError, match="here: image encoding '32FC1' is unknown"):
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
