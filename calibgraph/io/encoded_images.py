"""Images from PNG and JPEG data that is complete: OpenCV fills up what is damaged, unreported."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np
import simplejpeg
from numpy.typing import NDArray
from PIL.PngImagePlugin import PngImageFile

_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def is_png(data: bytes) -> bool:
    """Whether data begin as a PNG does."""
    return data.startswith(b"\x89PNG")


def decode_image(data: bytes, kind: int = _COLOUR) -> NDArray[Any]:
    """The image in PNG or JPEG data.

    Args:
        data: the bytes.
        kind: OpenCV's flags; by default for (height, width, 3) uint8, BGR.

    Raises:
        ValueError: if they are damaged, incomplete, or of another format.
    """
    try:
        if not is_png(data):
            return _decode_jpeg(data, gray=not kind & cv2.IMREAD_COLOR)
        PngImageFile(io.BytesIO(data)).verify()  # checksums, up to the end mark
        image = cv2.imdecode(np.frombuffer(data, np.uint8), kind)
    except (SyntaxError, OSError, ValueError, cv2.error) as error:
        raise ValueError(str(error)) from error
    if image is None:
        raise ValueError("its pixels")
    return np.asarray(image)


def _decode_jpeg(data: bytes, *, gray: bool) -> NDArray[Any]:
    pixels = np.asarray(simplejpeg.decode_jpeg(data, "GRAY" if gray else "BGR", strict=True))
    return pixels[:, :, 0] if gray else pixels
