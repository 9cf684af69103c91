"""Feather files: tables of Arrow."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import require_file
from calibgraph.io.correspondence_tables import arrow_reads


def feather_columns(path: Path) -> tuple[str, ...]:
    """The names of all columns of a file."""
    with arrow_reads(path):
        return tuple(_read_table(path).column_names)


def read_feather(path: Path, columns: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Columns of a file, as arrays of one length."""
    with arrow_reads(path):
        table = _read_table(path)
        for name in columns:
            if name not in table.column_names:
                found = ", ".join(table.column_names)
                raise FileError(path, f"column {name!r} is missing; found {found}")
        return {name: _array(path, table, name) for name in columns}


def _read_table(path: Path) -> Any:
    from pyarrow import feather

    return feather.read_table(require_file(path), memory_map=False)


def _array(path: Path, table: Any, name: str) -> NDArray[Any]:
    column = table.column(name)
    if column.null_count:
        raise FileError(path, f"column {name!r} has {column.null_count} empty values")
    return np.asarray(column.to_numpy())
