"""Images from PNG and JPEG data that is complete."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def decode_image(data: bytes, kind: int = cv2.IMREAD_COLOR) -> NDArray[Any] | None:
    """The image in PNG or JPEG data; None if it is incomplete or of another format.

    Args:
        data: the bytes.
        kind: OpenCV's flags, by default for (height, width, 3) uint8, BGR.
    """
    return cv2.imdecode(np.frombuffer(data, np.uint8), kind) if _ends_properly(data) else None


def _ends_properly(data: bytes) -> bool:
    """Whether the format's end mark is there: OpenCV decodes half a file without complaint."""
    if data.startswith(b"\x89PNG"):
        return data[-12:-8] == b"\0\0\0\0" and data[-8:-4] == b"IEND"
    return b"\xff\xd9" in data[-64:]
