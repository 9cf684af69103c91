"""The correspondence table on disk: Parquet, or CSV with the same columns."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.correspondences import Correspondences
from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.files import require_file, write_atomically

if TYPE_CHECKING:
    import pyarrow as pa

Array = NDArray[np.float64]

TABLE_FORMAT = "calibgraph-correspondences/1"

_COORDINATES = ("u_px", "v_px", "x_m", "y_m", "z_m")
_INFORMATION = ("i_uu_px", "i_uv_px", "i_vv_px")
_WHOLE = ("stamp_ns", "point_index")
_REQUIRED = ("camera", "frame", *_COORDINATES)
_COLUMNS = (*_REQUIRED, "confidence", *_WHOLE, *_INFORMATION)


def save_correspondences(table: Correspondences, path: Path) -> None:
    """Write a table as Parquet, or as CSV if the name ends in .csv, atomically."""
    from pyarrow import csv, parquet

    arrow = to_arrow(table)
    if path.suffix == ".csv":
        strings = arrow.set_column(0, "camera", arrow["camera"].cast("string"))
        write_atomically(path, lambda part: csv.write_csv(strings, part))
    else:
        write_atomically(path, lambda part: parquet.write_table(arrow, part))


def to_arrow(table: Correspondences) -> pa.Table:
    """The table in the file format's columns, its metadata in the schema."""
    import pyarrow as pa

    columns: dict[str, Any] = {
        "camera": pa.DictionaryArray.from_arrays(
            table.camera_index, pa.array(table.cameras, pa.string())
        ),
        "frame": table.frame,
        **dict(zip(_COORDINATES[:2], table.pixels_px.T, strict=True)),
        **dict(zip(_COORDINATES[2:], table.points_lidar_m.T, strict=True)),
        "confidence": table.confidence,
    }
    optional = {name: getattr(table, name) for name in _WHOLE}
    columns |= {name: column for name, column in optional.items() if column is not None}
    if table.information_px is not None:
        columns |= dict(zip(_INFORMATION, table.information_px.T, strict=True))
    metadata = {"format": TABLE_FORMAT, "matcher": json.dumps(table.metadata)}
    return pa.table(columns).replace_schema_metadata(metadata)


def load_correspondences(path: Path | str) -> Correspondences:
    """Read a table from Parquet, or from CSV with the same columns.

    Raises:
        FileError: if the file is missing, truncated, or lacks a column.
        CorrespondenceError: if a value is wrong.
    """
    import pyarrow as pa

    path = require_file(Path(path))
    table = _read_arrow(path)
    _check_form(path, table)
    try:
        return from_arrow(table)
    except CorrespondenceError as error:
        raise FileError(path, str(error)) from error
    except (ValueError, TypeError, RecursionError, pa.ArrowException) as error:
        raise FileError(path, f"a column or the metadata has the wrong type: {error}") from error


def _check_form(path: Path, table: pa.Table) -> None:
    """Whether a file has the columns and the format of a table, and rows."""
    missing = [name for name in _REQUIRED if name not in table.column_names]
    unknown = [name for name in table.column_names if name not in _COLUMNS]
    if missing:
        raise FileError(path, f"column {missing[0]!r} is missing; found {table.column_names}")
    if unknown:
        raise FileError(path, f"unknown column {unknown[0]!r}; known are {', '.join(_COLUMNS)}")
    if not len(table):
        raise FileError(path, "holds no rows; write the correspondences into it")
    if len(set(table.column_names)) < len(table.column_names):
        raise FileError(path, f"has a column twice: {table.column_names}; keep one")
    form = (
        (table.schema.metadata or {})
        .get(b"format", TABLE_FORMAT.encode())
        .decode("utf-8", "replace")
    )
    if form != TABLE_FORMAT:
        raise FileError(path, f"has the format {form!r}, expected {TABLE_FORMAT!r}")
    partial = [name for name in _INFORMATION if name in table.column_names]
    if partial and len(partial) < len(_INFORMATION):
        raise FileError(path, f"has only {partial} of the columns {list(_INFORMATION)}")


def from_arrow(table: pa.Table) -> Correspondences:
    """Build correspondences from an Arrow table that has the file format's columns."""
    import pyarrow as pa

    for name in table.column_names:
        if table[name].null_count:
            row = table[name].is_null().to_pylist().index(True)
            raise CorrespondenceError(f"row {row}: column {name!r} is empty; fill in or drop it")

    def column(name: str, dtype: type) -> NDArray[Any]:
        values = np.asarray(table[name].to_numpy())
        if values.dtype == np.uint64 and len(values) and values.max() < 2**63:
            values = values.astype(np.int64)
        if values.dtype.kind not in "iuf" or not np.can_cast(
            values.dtype, dtype, casting="same_kind" if dtype is not np.int64 else "safe"
        ):
            kind = "whole numbers" if dtype is np.int64 else "numbers"
            raise CorrespondenceError(
                f"column {name!r} must hold {kind}, found {table[name].type}: {values[:1].tolist()}"
            )
        return values.astype(dtype)

    def stack(names: Sequence[str]) -> Array:
        return np.stack([column(name, np.float64) for name in names], axis=1)

    given = table.column_names
    encoded = table["camera"].cast(pa.string()).combine_chunks().dictionary_encode()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.combine_chunks()
    metadata = json.loads((table.schema.metadata or {}).get(b"matcher", b"{}"))
    if not isinstance(metadata, dict):
        raise CorrespondenceError("the schema's metadata 'matcher' must be a JSON object")
    return Correspondences(
        cameras=tuple(encoded.dictionary.to_pylist()),
        camera_index=np.asarray(encoded.indices.to_numpy(zero_copy_only=False), dtype=np.int32),
        frame=column("frame", np.int64),
        pixels_px=stack(_COORDINATES[:2]),
        points_lidar_m=stack(_COORDINATES[2:]),
        confidence=column("confidence", np.float32)
        if "confidence" in given
        else np.ones(len(table), np.float32),
        information_px=stack(_INFORMATION) if _INFORMATION[0] in given else None,
        **{name: column(name, np.int64) for name in _WHOLE if name in given},
        metadata=metadata,
    )


def _read_arrow(path: Path) -> pa.Table:
    import pyarrow as pa
    from pyarrow import csv, parquet

    try:
        if path.suffix == ".csv":
            strings = csv.ConvertOptions(column_types={"camera": pa.string()})
            return csv.read_csv(path, convert_options=strings)
        return parquet.ParquetFile(path).read()
    except (pa.ArrowException, OSError) as error:
        kind = "CSV" if path.suffix == ".csv" else "Parquet"
        raise FileError(
            path, f"cannot be read as {kind} ({error}); is it complete? write it again"
        ) from error
