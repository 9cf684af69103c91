"""Images from PNG and JPEG data that is complete: OpenCV fills up what is damaged, unreported."""

import io
import struct
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL.ExifTags import Base
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

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
            return _decode_jpeg(data, gray=not kind & cv2.IMREAD_COLOR)
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


def _decode_jpeg(data: bytes, *, gray: bool) -> NDArray[Any]:
    pixels = np.asarray(simplejpeg.decode_jpeg(data, "GRAY" if gray else "BGR", strict=True))
    return pixels[:, :, 0] if gray else pixels
