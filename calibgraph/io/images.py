"""Images: PNG, JPEG and messages of bags, complete and of the size that the rig gives."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.bags import MESSAGE_SUFFIX, load_bag_image
from calibgraph.io.encoded_images import decode_image
from calibgraph.model.rig import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH  # without a reduction to 8 bits


def load_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Decode an image and check its size against the rig's.

    Args:
        path: a file, or the address of a message in a bag.
        camera: the camera that took it.

    Returns:
        (height, width, 3) uint8, BGR.

    Raises:
        FileError, DatasetError: if it is missing, truncated, or not of the size that the rig gives.
    """
    image = load_bag_image(path) if path.suffix == MESSAGE_SUFFIX else _read(path)
    found, expected = (image.shape[1], image.shape[0]), (camera.width_px, camera.height_px)
    if found != expected:
        raise FileError(
            path,
            f"is {found[0]}x{found[1]} px, the rig says {expected[0]}x{expected[1]} px; correct "
            "width_px and height_px, and the intrinsics if the image was scaled",
        )
    return image


def _read(path: Path) -> NDArray[np.uint8]:
    """The image in a file."""
    data = path.read_bytes() if path.is_file() else None
    if data is None:
        raise FileError(path, "no such image")
    image = decode_image(data)
    if image is None:
        raise FileError(path, "is truncated or not an image of its kind; record or copy it again")
    if not image.any() and np.any(cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)):
        raise FileError(path, "has 16 bits, of which only the lower 8 are used; write it with 8")
    return image
