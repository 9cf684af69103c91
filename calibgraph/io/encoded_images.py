"""PNG and JPEG data, complete, as images of 8 bits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def decode_image(data: bytes, *, gray: bool = False) -> NDArray[np.uint8] | None:
    """(height, width, 3) BGR, or (height, width); None if it is incomplete or no image."""
    if not _ends_properly(data):
        return None
    kind = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR
    image = cv2.imdecode(np.frombuffer(data, np.uint8), kind)
    return None if image is None else np.asarray(image, dtype=np.uint8)


def _ends_properly(data: bytes) -> bool:
    """Whether the format's end mark is there: OpenCV decodes half a file without complaint."""
    if data.startswith(b"\x89PNG"):
        return data[-12:-8] == b"\0\0\0\0" and data[-8:-4] == b"IEND"
    return b"\xff\xd9" in data[-64:]
