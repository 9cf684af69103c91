"""Tables from disk, by Arrow: of matches (Parquet, or CSV with the same columns), and Feather."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.files import require_file
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.correspondences import CAMERA_INDEX, Column, Correspondences, Table

if TYPE_CHECKING:
    import pyarrow as pa


_FEW_ROWS, _FEW_BYTES, _MOST_RATIO = 2**20, 2**26, 64
"""What any file may hold, and how many times its bytes otherwise: a row of five random coordinates
takes 12 bytes and more, however packed."""
_MOST_NAME_BYTES = 400  # 100 letters of 4 bytes
_FORMER = "point_index"  # a column of earlier tables, which is not read
_TEXT = ("string", "large_string", "string_view", "binary", "large_binary")

AnyTable = TypeVar("AnyTable", bound=Table)


def load_correspondences(path: Path | str) -> Correspondences:
    """Read a table from Parquet, or from CSV with the same columns.

    Raises:
        FileError: if the file is missing or truncated, lacks a column, or holds a wrong value.
    """
    found = _load(Path(path), Correspondences)
    if not len(found):
        raise FileError(path, "holds no rows; write the correspondences into it")
    return found


def load_camera_matches(path: Path | str) -> CameraMatches:
    """Read a table as :func:`load_correspondences` does."""
    return _load(Path(path), CameraMatches)


def _load(path: Path, kind: type[AnyTable]) -> AnyTable:
    arrow = _read_arrow(require_file(path), kind)
    try:
        return _from_arrow(arrow, kind)
    except CorrespondenceError as error:
        raise FileError(path, str(error)) from error


def _read_arrow(path: Path, kind: type[Table]) -> pa.Table:
    """A whole Parquet or CSV file, with any columns."""
    import pyarrow as pa
    from pyarrow import csv

    cameras = kind.COLUMNS[CAMERA_INDEX].names
    with arrow_reads(path):
        if path.suffix == ".csv":
            _require_commas(path)
            types = {
                name: pa.string() if name in cameras else pa.from_numpy_dtype(np.dtype(of.kind))
                for of in kind.COLUMNS.values()
                for name in of.names
            }
            return csv.read_csv(path, convert_options=csv.ConvertOptions(column_types=types))
        with _open_parquet(path, cameras) as file:
            return file.read()


def _require_commas(path: Path) -> None:
    """Check what separates the columns of a CSV file, by its first line."""
    with path.open("rb") as file:
        head = file.readline(2**16)
    for separator, name in ((b";", "semicolons"), (b"\t", "tabs")):
        if separator in head and b"," not in head:
            raise FileError(
                path, f"its columns are separated by {name}; save it with commas between columns, "
                "and points in numbers"
            )  # fmt: skip


def _open_parquet(path: Path, names: Sequence[str]) -> Any:
    """A Parquet file, its checksums verified; each value of the columns ``names`` is held once."""
    from pyarrow import parquet

    checked = partial(parquet.ParquetFile, path, page_checksum_verification=True)
    try:
        found = checked(read_dictionary=list(names))
    except KeyError:  # a column is missing, which is reported with the columns that are there
        found = checked()
    _require_plausible_size(path, found.metadata)
    return found


def _require_plausible_size(path: Path, footer: Any) -> None:
    """Check what a footer states of the rows, before memory is taken for them."""
    size = path.stat().st_size
    groups = [footer.row_group(i) for i in range(footer.num_row_groups)]
    unpacked = sum(group.total_byte_size for group in groups)
    rows_fit = 0 <= footer.num_rows <= max(_FEW_ROWS, size)
    if not rows_fit or unpacked > max(_FEW_BYTES, _MOST_RATIO * size):
        raise FileError(
            path, f"states {footer.num_rows} rows of {unpacked / 1e6:.0f} MB in {size / 1e6:.1f} "
            "MB: matches do not pack so; write it again"
        )  # fmt: skip


@contextmanager
def arrow_reads(path: Path) -> Iterator[None]:
    """Turn Arrow's errors about a file into ``FileError``."""
    import pyarrow as pa

    try:
        yield
    except (pa.ArrowException, OSError, ValueError) as error:
        kind = {".csv": "CSV", ".feather": "Feather"}.get(path.suffix.lower(), "Parquet")
        message = f"cannot be read as {kind} ({error}); is it complete? write it again"
        raise FileError(path, message) from error


def from_arrow(table: pa.Table) -> Correspondences:
    """Build correspondences from an Arrow table that has the file format's columns."""
    return _from_arrow(table, Correspondences)


def _from_arrow(table: pa.Table, kind: type[AnyTable]) -> AnyTable:
    import pyarrow as pa

    _check_schema(table.schema, kind)
    metadata, values = table.schema.metadata or {}, dict[str, Any]()
    try:
        for attribute, of in kind.COLUMNS.items():
            if of.names[0] not in table.column_names:
                continue
            for name in of.names:
                _require_full(table[name], name, of)
            if attribute == CAMERA_INDEX:
                stated = json.loads(metadata.get(b"cameras", b"null"))
                values["cameras"], numbers = _encode(table.select(of.names), stated)
            else:
                numbers = np.stack([_numbers(table, name, of.kind) for name in of.names], axis=1)
            values[attribute] = numbers.reshape(len(table), *of.of_row)
        if "confidence" in kind.COLUMNS:
            values.setdefault("confidence", np.ones(len(table), np.float32))
        values["metadata"] = json.loads(metadata.get(b"matcher", b"{}"))
        return kind(**values)
    except (ValueError, TypeError, RecursionError, pa.ArrowException) as error:
        message = f"a column or the metadata has the wrong type: {error}"
        raise CorrespondenceError(message) from error


def _check_schema(schema: pa.Schema, kind: type[Table]) -> None:
    """Check that a table has the columns and the format of the file, each of a right type."""
    try:
        names = [str(column.name) for column in schema]
    except UnicodeDecodeError as error:
        raise CorrespondenceError(f"a column's name is not UTF-8 ({error}); rename it") from error
    known = {name: of for of in kind.COLUMNS.values() for name in of.names}
    for of in kind.COLUMNS.values():
        missing = [name for name in of.names if name not in names]
        if missing and (of.required or len(missing) < len(of.names)):
            raise CorrespondenceError(f"column {missing[0]!r} is missing; found {names}")
    for name in names:
        if name not in (*known, _FORMER):
            raise CorrespondenceError(f"unknown column {name!r}; known are {', '.join(known)}")
        if names.count(name) > 1:
            raise CorrespondenceError(f"has the column {name!r} twice; keep one")
    form = (schema.metadata or {}).get(b"format", kind.FORMAT.encode()).decode("utf-8", "replace")
    if form != kind.FORMAT:
        raise CorrespondenceError(f"has the format {form!r}, expected {kind.FORMAT!r}")
    cameras = kind.COLUMNS[CAMERA_INDEX].names
    for name in known.keys() & {*names}:
        _check_type(schema.field(name), "text" if name in cameras else known[name].kind)


def _check_type(field: pa.Field, kind: str) -> None:
    """Check that a column has a plain type, whose size in memory is the size of the data.

    A few bytes of run-end encoded values, for example, could expand to any number of rows.
    """
    from pyarrow import types

    if types.is_null(field.type):
        raise CorrespondenceError(f"column {field.name!r} is empty; fill in or drop it")
    if kind == "text":
        named = field.type.value_type if types.is_dictionary(field.type) else field.type
        what, right = kind, str(named) in _TEXT or types.is_integer(named)
    else:
        what, right = "whole numbers", types.is_integer(field.type)
        if kind.startswith("f"):
            what, right = "numbers", right or types.is_floating(field.type)
    if not right:
        raise CorrespondenceError(f"column {field.name!r} must hold {what}, found {field.type}")


def _require_full(column: pa.ChunkedArray, name: str, of: Column) -> None:
    """Check that a column has a value in every row.

    Before that, how long the names of a dictionary are: its rows would take memory for one each.
    """
    import pyarrow as pa
    from pyarrow import compute

    is_coded = pa.types.is_dictionary(column.type)
    for chunk in column.chunks if is_coded else ():
        longest = compute.max(compute.binary_length(chunk.dictionary)).as_py() or 0
        if longest > _MOST_NAME_BYTES:
            raise CorrespondenceError(
                f"column {name!r} holds a name of {longest} bytes; give the names of the rig"
            )
    column = column.cast(pa.string()) if is_coded else column  # a dictionary may hold a null
    if column.null_count and not of.gaps:
        row = column.is_null().to_pylist().index(True)
        raise CorrespondenceError(f"column {name!r} is empty; fill in or drop it", row=row)


def _encode(
    names: pa.Table, stated: Sequence[str] | None
) -> tuple[tuple[str, ...], NDArray[np.int32]]:
    """The cameras, those that are stated or in the order of the rows, and (n, k) their numbers."""
    import pyarrow as pa

    chunks = [chunk for column in names.columns for chunk in column.cast(pa.string()).chunks]
    encoded = pa.chunked_array(chunks, pa.string()).combine_chunks().dictionary_encode()
    found = encoded.dictionary.to_pylist()
    cameras = tuple(stated or found)
    number = np.array([cameras.index(name) for name in found], np.int32)
    return cameras, number[encoded.indices.to_numpy()].reshape(names.num_columns, -1).T


def _numbers(table: pa.Table, name: str, kind: str) -> NDArray[Any]:
    values = table[name].to_numpy()
    if values.dtype == np.uint64 and kind == "i8" and (values >= 2**63).any():
        raise CorrespondenceError(f"column {name!r} holds a number beyond 64 bits")
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such
        return np.asarray(values.astype(kind))


_PACKED = np.array([0x184D2204, 0xFD2FB528], np.uint32)


def read_feather(path: Path) -> tuple[list[str], Callable[[str], NDArray[Any]]]:
    """The names of a file's columns, and a function that returns one as an array."""
    from pyarrow import feather

    with arrow_reads(path):
        _require_plausible_buffers(require_file(path))
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


def _require_plausible_buffers(path: Path) -> None:
    """Check what the packed buffers of a file state, before memory is taken for them.

    Each begins with its unpacked length, in 8 bytes, and the mark of LZ4 or Zstandard.
    """
    words = np.fromfile(path, "<u4", offset=0)
    marks = np.flatnonzero(np.isin(words[2::2], _PACKED))
    lengths = words[2 * marks].astype(np.int64) + (words[2 * marks + 1].astype(np.int64) << 32)
    unpacked, size = int(lengths[lengths >= 0].sum()), path.stat().st_size
    if unpacked > max(_FEW_BYTES, _MOST_RATIO * size):
        raise FileError(
            path, f"states {unpacked / 1e6:.0f} MB in {size / 1e6:.1f} MB: points do not pack so; "
            "write it again"
        )  # fmt: skip
