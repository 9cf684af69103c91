"""Images from disk: PNG and JPEG, complete and of the size that the rig gives."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.model.rig import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH  # without a reduction to 8 bits


def load_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Decode an image and check its size against the rig's.

    Returns:
        (height, width, 3) uint8, BGR.

    Raises:
        FileError: if it is missing, truncated, or not of the size that the rig gives.
    """
    data = path.read_bytes() if path.is_file() else None
    if data is None:
        raise FileError(path, "no such image")
    if not _ends_properly(data, path.suffix.lower()):
        raise FileError(path, "is truncated or not an image of its kind; record or copy it again")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise FileError(path, "cannot be decoded as an image; is it complete?")
    found, expected = (image.shape[1], image.shape[0]), (camera.width_px, camera.height_px)
    if found != expected:
        raise FileError(
            path,
            f"is {found[0]}x{found[1]} px, the rig says {expected[0]}x{expected[1]} px; correct "
            "width_px and height_px, and the intrinsics if the image was scaled",
        )
    if not image.any() and np.any(cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)):
        raise FileError(path, "has 16 bits, of which only the lower 8 are used; write it with 8")
    return np.asarray(image, dtype=np.uint8)


def _ends_properly(data: bytes, suffix: str) -> bool:
    """Whether the format's end mark is there: OpenCV decodes half a file without complaint."""
    if suffix == ".png":
        return data[-12:-8] == b"\0\0\0\0" and data[-8:-4] == b"IEND"
    return b"\xff\xd9" in data[-64:]
