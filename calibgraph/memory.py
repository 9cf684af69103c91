"""Arrays for long-lived values, outside the heap; and what the heap keeps."""

import ctypes
import math
import mmap
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

Scalar = TypeVar("Scalar", bound=np.generic)
_MALLOC_OPTIONS = {-8: 1, -3: 2**26, -1: 2**28}
"""glibc's M_ARENA_MAX, M_MMAP_THRESHOLD and M_TRIM_THRESHOLD [bytes]."""


def keep_freed_memory() -> None:
    """Let this process keep up to 256 MB that it freed, where the C library is glibc.

    Temporary arrays of several threads would otherwise come in new pages each time: a third of
    the page faults of ``calibrate``. One arena, or each thread would keep its own.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option, value in _MALLOC_OPTIONS.items():
            mallopt(option, value)


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
