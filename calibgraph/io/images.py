"""Images from disk: PNG and JPEG, complete and of the size that the rig gives."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL.ExifTags import Base
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile

from calibgraph.errors import FileError
from calibgraph.model.rig import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH  # without a reduction to 8 bits
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_UPRIGHT = (0, 1)  # orientations; 0 is not one, but some cameras write it


def load_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Decode an image, after its header's size was checked against the rig's.

    Returns:
        (height, width, 3) uint8, BGR.

    Raises:
        FileError: if it is missing, damaged, marked as turned, or not of the size that the rig
            gives.
    """
    data, header = _read(path)
    expected = camera.width_px, camera.height_px
    if header.size != expected:
        raise FileError(
            path,
            f"is {header.width}x{header.height} px, the rig says {expected[0]}x{expected[1]} px; "
            "correct width_px and height_px, and the intrinsics if the image was scaled",
        )
    if not _is_png(data) or b"eXIf" in data:  # Pillow decodes a PNG whole to look for it
        _require_upright(path, header)
    image = _decode(path, data)
    if not image.any() and np.any(cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)):
        raise FileError(path, "has 16 bits, of which only the lower 8 are used; write it with 8")
    return image


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header.

    Raises:
        FileError: if the image is missing, or its header damaged.
    """
    return _read(path)[1].size


def _read(path: Path) -> tuple[bytes, ImageFile]:
    """The bytes of a file, and the header in them."""
    if not path.is_file():
        raise FileError(path, "no such image")
    data = path.read_bytes()
    kind = PngImageFile if _is_png(data) else JpegImageFile
    try:
        return data, kind(io.BytesIO(data))
    except (SyntaxError, OSError, ValueError) as error:
        raise _damaged(path, error) from error


def _is_png(data: bytes) -> bool:
    return data.startswith(b"\x89PNG")


def _require_upright(path: Path, header: ImageFile) -> None:
    """Refuse an orientation: it is unknown which pixels the intrinsics count, turned or stored."""
    try:
        found = header.getexif().get(Base.Orientation, 1)
    except (SyntaxError, OSError, ValueError) as error:
        raise _damaged(path, error) from error
    if found not in _UPRIGHT:
        raise FileError(
            path,
            f"has the EXIF orientation {found}, by which some programs turn it and others do not; "
            "write the images without it, and the intrinsics for the pixels as they are stored",
        )


def _decode(path: Path, data: bytes) -> NDArray[np.uint8]:
    """(height, width, 3) BGR. OpenCV fills up damaged images, and does not report it."""
    try:
        if not _is_png(data):
            return np.asarray(simplejpeg.decode_jpeg(data, "BGR", strict=True))
        PngImageFile(io.BytesIO(data)).verify()  # checksums, up to the end mark
        image = cv2.imdecode(np.frombuffer(data, np.uint8), _COLOUR)
    except (SyntaxError, OSError, ValueError, cv2.error) as error:
        raise _damaged(path, error) from error
    if image is None:
        raise _damaged(path, "its pixels")
    return np.asarray(image, np.uint8)


def _damaged(path: Path, why: object) -> FileError:
    message = f"is damaged, or not an image of its kind ({why}); record or copy it again"
    return FileError(path, message)
