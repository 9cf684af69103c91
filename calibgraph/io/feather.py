"""Feather files: tables of Arrow."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import require_file
from calibgraph.io.correspondence_tables import arrow_reads

_MARKS = np.array([0x184D2204, 0xFD2FB528], np.uint32)
_FEW_BYTES, _MOST_RATIO = 2**26, 64


def read_feather(path: Path) -> tuple[list[str], Callable[[str], NDArray[Any]]]:
    """The names of a file's columns, and a function that returns one as an array."""
    from pyarrow import feather

    with arrow_reads(path):
        _require_plausible_size(require_file(path))
        table = feather.read_table(path, memory_map=False)
        table.validate(full=True)  # Arrow believes offsets and lengths, and would read elsewhere

    def column(name: str) -> NDArray[Any]:
        if name not in table.column_names:
            found = ", ".join(table.column_names)
            raise FileError(path, f"column {name!r} is missing; found {found}")
        values = table.column(name)
        if values.null_count:
            raise FileError(path, f"column {name!r} has {values.null_count} empty values")
        with arrow_reads(path):
            return np.asarray(values.to_numpy())

    return table.column_names, column


def _require_plausible_size(path: Path) -> None:
    """Check what the packed buffers of a file state, before memory is taken for them.

    Each begins with its unpacked length, in 8 bytes, and the mark of LZ4 or Zstandard.
    """
    words = np.fromfile(path, "<u4", offset=0)
    marks = np.flatnonzero(np.isin(words[2::2], _MARKS))
    lengths = words[2 * marks].astype(np.int64) + (words[2 * marks + 1].astype(np.int64) << 32)
    unpacked, size = int(lengths[lengths >= 0].sum()), path.stat().st_size
    if unpacked > max(_FEW_BYTES, _MOST_RATIO * size):
        raise FileError(
            path, f"states {unpacked / 1e6:.0f} MB in {size / 1e6:.1f} MB: points do not pack so; "
            "write it again"
        )  # fmt: skip
