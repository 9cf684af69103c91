"""Arrays for long-lived values, outside the heap."""

import math
import mmap
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

Scalar = TypeVar("Scalar", bound=np.generic)


def mmap_zeros(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """An array of zeros in pages of its own; only written pages take memory.

    They return to the system with the array. On the heap, arrays that are kept would lie between
    the temporary ones of several threads, and hold these threads' memory.
    """
    count, flags = math.prod(shape), mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS
    pages = mmap.mmap(-1, max(1, count * np.dtype(dtype).itemsize), flags=flags)
    return np.frombuffer(pages, dtype, count).reshape(shape)


def mmap_copy(values: NDArray[Scalar]) -> NDArray[Scalar]:
    """A copy of an array in pages of its own, see :func:`mmap_zeros`."""
    kept: NDArray[Scalar] = mmap_zeros(values.shape, values.dtype)
    kept[...] = values
    return kept
