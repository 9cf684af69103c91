from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from calibgraph.memory import mmap_zeros

PAGE = os.sysconf("SC_PAGE_SIZE")


def resident_bytes() -> int:
    return PAGE * int(Path("/proc/self/statm").read_text().split()[1])


def test_only_what_is_written_takes_memory_until_the_array_is_gone() -> None:
    size = 400_000_000
    before = resident_bytes()
    values = mmap_zeros((size,), np.uint8)
    assert resident_bytes() - before < size / 100
    values[: size // 4] = 1
    assert size / 5 < resident_bytes() - before < size / 3
    del values
    assert resident_bytes() - before < size / 100


_COUNT_FAULTS = """
import resource, sys, numpy
from calibgraph.memory import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
faults = []
for _ in range(101):
    numpy.ones(5 * 2**20)  # 40 MB
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[-1] - faults[0])
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the options are glibc's")
def test_freed_arrays_are_used_again_without_page_faults() -> None:
    def faults(how: str) -> int:
        command = [sys.executable, "-c", _COUNT_FAULTS, how]
        return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)

    assert faults("keep") < 100 <= faults("return")  # of 100 arrays, each of many pages
