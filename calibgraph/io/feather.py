"""Feather files: tables of Arrow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import require_file


def read_feather(
    path: Path, columns: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, NDArray[Any]]:
    """Columns of a file, as arrays of one length.

    Args:
        path: of the file.
        columns: that it must have.
        optional: that it may have.

    Raises:
        FileError: if it cannot be read, a column is missing, or a value is.
    """
    import pyarrow as pa
    from pyarrow import feather

    require_file(path)
    try:
        table = feather.read_table(path, memory_map=False)
        for name in columns:
            if name not in table.column_names:
                found = ", ".join(table.column_names)
                raise FileError(path, f"column {name!r} is missing; found {found}")
        wanted = [*columns, *(name for name in optional if name in table.column_names)]
        return {name: _array(path, table, name) for name in wanted}
    except (pa.ArrowException, OSError, ValueError) as error:
        raise FileError(path, f"cannot be read as Feather ({error}); is it complete?") from error


def _array(path: Path, table: Any, name: str) -> NDArray[Any]:
    column = table.column(name)
    if column.null_count:
        raise FileError(path, f"column {name!r} has {column.null_count} empty values")
    return np.asarray(column.to_numpy())
