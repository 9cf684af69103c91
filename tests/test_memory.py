from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from calibgraph.memory import mmap_copy, mmap_zeros

PAGE = os.sysconf("SC_PAGE_SIZE")


def resident_bytes() -> int:
    return PAGE * int(Path("/proc/self/statm").read_text().split()[1])


@pytest.mark.parametrize("shape", [(), (0, 3), (5,), (2, 3, 4)])
def test_reserved_arrays_are_zero_and_writable(shape: tuple[int, ...]) -> None:
    values = mmap_zeros(shape, np.float32)
    assert values.shape == shape and values.dtype == np.float32
    assert not values.any()
    values[...] = 7
    assert (values == 7).all()


def test_a_kept_array_is_a_copy() -> None:
    original = np.arange(12).reshape(3, 4)
    kept = mmap_copy(original)
    np.testing.assert_array_equal(kept, original)
    kept[0, 0] = 5
    assert original[0, 0] == 0


def test_only_what_is_written_takes_memory_until_the_array_is_gone() -> None:
    size = 400_000_000
    before = resident_bytes()
    values = mmap_zeros((size,), np.uint8)
    assert resident_bytes() - before < size / 100
    values[: size // 4] = 1
    assert size / 5 < resident_bytes() - before < size / 3
    del values
    assert resident_bytes() - before < size / 100
