"""Images: PNG, JPEG and messages of bags, complete and of the rig's size."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.bags import MESSAGE_SUFFIX, load_bag_image
from calibgraph.io.encoded_images import decode_image, describe_turn, encoded_size
from calibgraph.model.rig import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")

_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH  # without a reduction to 8 bits


def load_image(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """Decode an image, after its header's size was checked against the rig's.

    Returns:
        (height, width, 3) uint8, BGR.

    Raises:
        FileError, DatasetError: if it is missing, damaged, marked as turned, or not of the size
            that the rig gives.
    """
    if path.suffix == MESSAGE_SUFFIX:
        image = load_bag_image(path)
        _require_size(path, (image.shape[1], image.shape[0]), camera)
        return image
    data = _read(path)
    try:
        _require_size(path, encoded_size(data), camera)
        turned, image = describe_turn(data), np.asarray(decode_image(data), np.uint8)
    except ValueError as error:
        raise _damaged(path, error) from error
    if turned:
        raise FileError(path, turned)
    if not image.any() and np.any(cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)):
        raise FileError(path, "has 16 bits and uses only the lower 8; write it with 8")
    return image


def _require_size(path: Path, found: tuple[int, int], camera: Camera) -> None:
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
