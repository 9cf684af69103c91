"""LZF, in which PCL compresses point clouds."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

MOST_RATIO = 88
"""Three bytes stand for at most 264."""

_LITERALS, _LONG = 32, 7  # controls below are literal bytes; lengths from here on have a byte more


def unpack_lzf(data: NDArray[np.uint8], size: int) -> NDArray[np.uint8] | None:
    """(size,) the unpacked bytes; None if the data are damaged or unpack to another size."""
    out = np.empty(size, np.uint8)
    return out if _unpack(data, out) == size else None


@compiled(boundscheck=True)
def _unpack(data: Any, out: Any) -> int:  # noqa: PLR0911
    """Fill ``out``; the number of bytes written, -1 if the data refer beyond it or end early."""
    at, end = 0, 0
    while at < len(data):
        control: Any = np.int64(data[at])
        at += 1
        if control < _LITERALS:
            length = control + 1
            if at + length > len(data) or end + length > len(out):
                return -1
            for k in range(length):
                out[end + k] = data[at + k]
            at += length
        else:
            length = control >> 5
            if length == _LONG and at < len(data):
                length += np.int64(data[at])
                at += 1
            if at >= len(data):
                return -1
            start = end - ((control & 31) << 8) - np.int64(data[at]) - 1
            at += 1
            length += 2
            if start < 0 or end + length > len(out):
                return -1
            for k in range(length):
                out[end + k] = out[start + k]
        end += length
    return end
