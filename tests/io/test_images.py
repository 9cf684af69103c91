"""Images from disk: what is incomplete or of another size is refused by name."""

from __future__ import annotations

import io
import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import Base

from calibgraph import FileError, load_rig
from calibgraph.io.images import load_image
from tests.conftest import SAMPLE, make_camera


def test_truncated_and_wrong_images_are_named(tmp_path: Path) -> None:
    camera = load_rig(SAMPLE).cameras["left"]
    jpg = Path(shutil.copy(SAMPLE / "cameras" / "left" / "000000.jpg", tmp_path))
    image = cv2.imread(str(jpg))
    png = tmp_path / "image.png"
    cv2.imwrite(str(png), image)
    np.testing.assert_array_equal(load_image(png, camera), image)
    for path in (jpg, png):
        data = path.read_bytes()
        for part in (data[: len(data) // 2], data[:-5], b"", b"no image at all"):
            path.write_bytes(part)
            with pytest.raises(FileError, match=path.name):
                load_image(path, camera)
    cv2.imwrite(str(png), image[:, :-2])
    with pytest.raises(FileError, match=r"is 638x360 px, the rig says 640x360 px"):
        load_image(png, camera)


def png(width_px: int, height_px: int, pixels: bytes) -> bytes:
    """A PNG with this header, whatever its pixels are."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        checked = kind + data
        return struct.pack(">I", len(data)) + checked + struct.pack(">I", zlib.crc32(checked))

    header = struct.pack(">IIBBBBB", width_px, height_px, 8, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(pixels)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize("side_px", [28_000, 10**6, 2**31 - 1])
def test_a_size_is_compared_before_memory_is_taken_for_it(side_px: int, tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png(side_px, side_px, bytes(1000)))
    with pytest.raises(FileError, match=f"is {side_px}x{side_px} px, the rig says 1240x376 px"):
        load_image(path, make_camera())


def sample_jpeg() -> bytes:
    return (SAMPLE / "cameras" / "left" / "000000.jpg").read_bytes()


def damaged_images() -> dict[str, bytes]:
    """Images whose first and last bytes are right."""
    jpg, camera = sample_jpeg(), load_rig(SAMPLE).cameras["left"]
    middle = len(jpg) // 2
    image = cv2.imencode(".png", cv2.imdecode(np.frombuffer(jpg, np.uint8), cv2.IMREAD_COLOR))[1]
    flipped = bytearray(image.tobytes())
    flipped[len(flipped) // 2] ^= 255
    return {
        "half.jpg": jpg[:middle] + b"\xff\xd9",
        "gap.jpg": jpg[:middle] + jpg[middle + 500 :],
        "flipped.png": bytes(flipped),
        "short.png": png(camera.width_px, camera.height_px, bytes(1000)),
    }


@pytest.mark.parametrize("name", damaged_images())
def test_a_damaged_image_is_not_filled_up(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(damaged_images()[name])
    with pytest.raises(FileError, match=f"{name}: is damaged"):
        load_image(path, load_rig(SAMPLE).cameras["left"])


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_an_image_that_programs_turn_differently_is_refused(
    orientation: int, suffix: str, tmp_path: Path
) -> None:
    exif, path = Image.Exif(), tmp_path / f"turned.{suffix}"
    exif[Base.Orientation] = orientation
    Image.open(io.BytesIO(sample_jpeg())).save(path, exif=exif)
    camera = load_rig(SAMPLE).cameras["left"]
    if orientation == 1:
        assert load_image(path, camera).any()
    else:
        with pytest.raises(FileError, match=f"has the EXIF orientation {orientation}"):
            load_image(path, camera)


def test_an_image_that_16_bits_make_black_is_named(tmp_path: Path) -> None:
    camera = make_camera()
    path = tmp_path / "dark.png"
    cv2.imwrite(str(path), np.full((camera.height_px, camera.width_px), 200, np.uint16))
    with pytest.raises(FileError, match="16 bits and uses only the lower 8"):
        load_image(path, camera)


def test_profiles_in_a_png_print_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Libpng's warnings would be lines on a user's terminal; the pixels do not depend on them."""
    camera = make_camera()
    pixels = np.random.default_rng(0).integers(0, 256, (camera.height_px, camera.width_px, 3))
    image = Image.fromarray(pixels.astype(np.uint8))
    image.save(tmp_path / "bad.png", icc_profile=b"no profile" * 20)
    np.testing.assert_array_equal(load_image(tmp_path / "bad.png", camera), pixels[:, :, ::-1])
    assert capfd.readouterr().err == ""


def test_a_png_may_be_followed_by_other_bytes(tmp_path: Path) -> None:
    camera = make_camera()
    data = png(
        camera.width_px, camera.height_px, bytes((3 * camera.width_px + 1) * camera.height_px)
    )
    (tmp_path / "more.png").write_bytes(data + b"more")
    (tmp_path / "plain.png").write_bytes(data)
    more, plain = (load_image(tmp_path / f"{name}.png", camera) for name in ("more", "plain"))
    np.testing.assert_array_equal(more, plain)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_image_that_states_more_pixels_than_its_bytes_hold_is_refused(
    suffix: str, tmp_path: Path
) -> None:
    side = 6000
    path, size = tmp_path / f"image{suffix}", {"width_px": side, "height_px": side}
    camera = make_camera().model_copy(update=size)
    cv2.imwrite(str(path), np.zeros((side, side), np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 5])
    with pytest.raises(FileError, match=r"it states 6000x6000 px in \d+ kB: no picture packs so"):
        load_image(path, camera)
