"""Images in PNG and JPEG files: complete, of the rig's size, without what is burnt in."""

import io
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL.ExifTags import Base
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from calibgraph.errors import FileError
from calibgraph.model.rig import Camera

_PNG_MARK = b"\x89PNG\r\n\x1a\n"
_END = b"\0\0\0\0IEND\xaeB`\x82"
_UPRIGHT = (0, 1)  # orientations; 0 is not one, but some cameras write it
_AROUND_CHUNK = 12  # bytes of a chunk's length, name and checksum

_FEW_PIXELS, _MOST_PER_BYTE = 2**25, 40
"""Pixels that any image may have, and how many for each of its bytes otherwise: JPEG at the lowest
quality has 20, a picture of one colour 85."""

_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def is_png(data: bytes) -> bool:
    """Whether data begin as a PNG does."""
    return data.startswith(b"\x89PNG")


def decode_image(data: bytes, kind: int = _COLOUR) -> NDArray[Any]:
    """The image in PNG or JPEG data.

    Raises:
        ValueError: if they are damaged, incomplete, or of another format.
    """
    try:
        _require_plausible_size(data)
        if not is_png(data):
            colours = "BGR" if kind & cv2.IMREAD_COLOR else "GRAY"
            pixels = np.asarray(simplejpeg.decode_jpeg(data, colours, strict=True))
            return pixels if colours == "BGR" else pixels[:, :, 0]
        PngImageFile(io.BytesIO(data)).verify()  # checksums, up to the end mark
        image = cv2.imdecode(np.frombuffer(_pixels_alone(data), np.uint8), kind)
    except (SyntaxError, OSError, ValueError, cv2.error) as error:
        raise ValueError(str(error)) from error
    if image is None:
        raise ValueError("its pixels")
    return np.asarray(image)


def encoded_size(data: bytes) -> tuple[int, int]:
    """Width and height that the header of PNG or JPEG data states.

    Raises:
        ValueError: if it is damaged.
    """
    return _header(data).size


def _header(data: bytes) -> PngImageFile | JpegImageFile:
    try:
        return (PngImageFile if is_png(data) else JpegImageFile)(io.BytesIO(data))
    except (SyntaxError, OSError) as error:
        raise ValueError(str(error)) from error


def _require_plausible_size(data: bytes) -> None:
    """Check the size that a header states, before memory is taken for the pixels."""
    width, height = encoded_size(data)
    if width * height > max(_FEW_PIXELS, _MOST_PER_BYTE * len(data)):
        raise ValueError(
            f"it states {width}x{height} px in {len(data) / 1e3:.0f} kB: no picture packs so"
        )


def describe_turn(data: bytes) -> str:
    """What is wrong with an orientation in PNG or JPEG data; empty if the image is upright.

    It is unknown which pixels the intrinsics count, turned or stored.

    Raises:
        ValueError: if the header is damaged.
    """
    if is_png(data) and b"eXIf" not in data:  # Pillow decodes a PNG whole to look for it
        return ""
    try:
        found = _header(data).getexif().get(Base.Orientation, 1)
    except (SyntaxError, OSError) as error:
        raise ValueError(str(error)) from error
    return "" if found in _UPRIGHT else (
        f"has the EXIF orientation {found}, by which some programs turn it and others do not; "
        "write the images without it, and the intrinsics for the pixels as they are stored"
    )  # fmt: skip


def _pixels_alone(png: bytes) -> bytes:
    """A verified PNG without what does not change its pixels.

    libpng prints warnings about profiles and gammas, which OpenCV ignores.
    """
    kept, place = [png[: len(_PNG_MARK)]], len(_PNG_MARK)
    while kept[-1][4:8] != b"IEND":
        (length,) = struct.unpack_from(">I", png, place)
        end = place + length + _AROUND_CHUNK
        if png[place + 4 : place + 5].isupper() or png[place + 4 : place + 8] == b"tRNS":
            kept.append(png[place:end])
        place = end
    if kept[-1] != _END:
        raise ValueError("its end mark")
    return b"".join(kept)


IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH  # without a reduction to 8 bits


def load_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Decode an image, after its header's size was checked against the rig's.

    Returns:
        (height, width, 3) uint8, BGR.
    """
    data = _read(path)
    try:
        require_size(path, encoded_size(data), camera)
        turned, image = describe_turn(data), np.asarray(decode_image(data), np.uint8)
    except ValueError as error:
        raise _damaged(path, error) from error
    if turned:
        raise FileError(path, turned)
    if not image.any() and np.any(cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)):
        raise FileError(path, "has 16 bits and uses only the lower 8; write it with 8")
    return image


def require_size(path: Path, found: tuple[int, int], camera: Camera) -> None:
    """Check the width and height of an image."""
    expected = camera.width_px, camera.height_px
    if found != expected:
        raise FileError(
            path,
            f"is {found[0]}x{found[1]} px, the rig says {expected[0]}x{expected[1]} px; "
            "correct width_px and height_px, and the intrinsics if the image was scaled",
        )


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header."""
    try:
        return encoded_size(_read(path))
    except ValueError as error:
        raise _damaged(path, error) from error


def _read(path: Path) -> bytes:
    if not path.is_file():
        raise FileError(path, "no such image")
    return path.read_bytes()


def _damaged(path: Path, why: object) -> FileError:
    message = f"is damaged, or not an image of its kind ({why}); record or copy it again"
    return FileError(path, message)


Image = NDArray[np.uint8]
Rectangle = tuple[int, int, int, int]

_MARGIN_PX = 16


@dataclass(frozen=True, eq=False)
class BurntIn:
    """What is burnt into a camera's images.

    Attributes:
        mask: (height, width) its pixels.
        rectangles: (left, top, right, bottom) [px] of each thing; right and bottom are outside.
    """

    mask: NDArray[np.bool_]
    rectangles: tuple[Rectangle, ...]

    def fill(self, image: Image) -> Image:
        """The (height, width, 3) image with smooth pixels in its place, which have no features."""
        rows, columns = (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        near = tuple(
            slice(max(0, int(found[0]) - _MARGIN_PX), int(found[-1]) + 1 + _MARGIN_PX)
            for found in (rows, columns)
        )
        mask, filled = self.mask[near], image.copy()
        known = (~mask).astype(np.float32)
        smooth = _fill(filled[near] * known[..., None], known)
        filled[near][mask] = smooth[mask].round().astype(np.uint8)
        return filled


def _fill(weighted: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of what is known; where nothing is, of a smaller image, and so on."""
    known = weight > 0
    means = weighted / np.where(known, weight, 1)[..., None]
    if known.all() or not known.any():
        return np.asarray(means, np.float32)
    half = tuple(-(-side // 2) for side in weight.shape[::-1])
    smaller = [
        np.asarray(cv2.resize(one, half, interpolation=cv2.INTER_AREA), np.float32)
        for one in (weighted, weight)
    ]
    around = cv2.resize(_fill(*smaller), weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(known[..., None], means, around)
