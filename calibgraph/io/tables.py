"""Tables from disk, by Arrow: of matches (Parquet, or CSV with the same columns), and Feather."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.files import require_file
from calibgraph.model.camera_matches import COLUMNS, FORMAT, NAMES, NUMBERS, PLANES, CameraMatches
from calibgraph.model.correspondences import (
    COORDINATES,
    INFORMATION,
    LATE,
    TWIST,
    Correspondences,
    as_confidence,
    check_schema,
)

if TYPE_CHECKING:
    import pyarrow as pa


_FEW_ROWS, _FEW_BYTES, _MOST_RATIO = 2**20, 2**26, 64
"""What any file may hold, and how many times its bytes otherwise: a row of five random coordinates
takes 12 bytes and more, however packed."""
_MOST_NAME_BYTES = 400  # 100 letters of 4 bytes


def load_correspondences(path: Path | str) -> Correspondences:
    """Read a table from Parquet, or from CSV with the same columns.

    Raises:
        FileError: if the file is missing or truncated, lacks a column, or holds a wrong value.
    """
    path = require_file(Path(path))
    table = read_arrow(path)
    if not len(table):
        raise FileError(path, "holds no rows; write the correspondences into it")
    try:
        return from_arrow(table)
    except CorrespondenceError as error:
        raise FileError(path, str(error)) from error


def read_arrow(
    path: Path, names: Sequence[str] = ("camera",), types: Mapping[str, str] | None = None
) -> pa.Table:
    """A whole Parquet or CSV file, with any columns; in CSV ``names`` are texts."""
    import pyarrow as pa
    from pyarrow import csv

    with arrow_reads(path):
        if path.suffix == ".csv":
            _require_commas(path)
            column_types = {**dict.fromkeys(names, pa.string()), **(types or {})}
            options = csv.ConvertOptions(column_types=column_types)
            return csv.read_csv(path, convert_options=options)
        with open_parquet(path, names) as file:
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


def open_parquet(path: Path, names: Sequence[str] = ("camera",)) -> Any:
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
    import pyarrow as pa

    check_schema(table.schema)
    try:
        require_short_names(table["camera"])
        # As plain strings: a dictionary may contain a null name.
        names = table["camera"].cast(pa.string())
        camera = table.column_names.index("camera")
        return _from_plain_columns(table.set_column(camera, "camera", names))
    except (ValueError, TypeError, RecursionError, pa.ArrowException) as error:
        message = f"a column or the metadata has the wrong type: {error}"
        raise CorrespondenceError(message) from error


def require_short_names(column: pa.ChunkedArray) -> None:
    """Check the names of a dictionary before each of its rows takes memory for one."""
    import pyarrow as pa
    from pyarrow import compute

    if not pa.types.is_dictionary(column.type):
        return
    for chunk in column.chunks:
        longest = compute.max(compute.binary_length(chunk.dictionary)).as_py() or 0
        if longest > _MOST_NAME_BYTES:
            raise CorrespondenceError(
                f"column 'camera' holds a name of {longest} bytes; give the names of the rig"
            )


def require_no_nulls(table: pa.Table, names: Iterable[str]) -> None:
    """Check that columns have a value in every row."""
    for name in names:
        if table[name].null_count:
            row = table[name].is_null().to_pylist().index(True)
            raise CorrespondenceError(f"column {name!r} is empty; fill in or drop it", row=row)


def _from_plain_columns(table: pa.Table) -> Correspondences:
    import pyarrow as pa

    require_no_nulls(table, table.column_names)

    given = table.column_names
    encoded = table["camera"].combine_chunks().dictionary_encode()
    if isinstance(encoded, pa.ChunkedArray):
        encoded = encoded.combine_chunks()
    return Correspondences(
        cameras=tuple(encoded.dictionary.to_pylist()),
        camera_index=np.asarray(encoded.indices.to_numpy(zero_copy_only=False), dtype=np.int32),
        frame=_whole(table, "frame"),
        pixels_px=_stack(table, COORDINATES[:2]),
        points_lidar_m=_stack(table, COORDINATES[2:]),
        confidence=as_confidence(table["confidence"].to_numpy())
        if "confidence" in given
        else np.ones(len(table), np.float32),
        information_px=_stack(table, INFORMATION) if INFORMATION[0] in given else None,
        twist_per_s=_stack(table, TWIST) if TWIST[0] in given else None,
        late_s=table[LATE].to_numpy().astype(np.float64) if LATE in given else None,
        stamp_ns=_whole(table, "stamp_ns") if "stamp_ns" in given else None,
        metadata=json.loads((table.schema.metadata or {}).get(b"matcher", b"{}")),
    )


def _stack(table: pa.Table, names: Sequence[str]) -> Array:
    return np.stack([table[name].to_numpy().astype(np.float64) for name in names], axis=1)


def _whole(table: pa.Table, name: str) -> NDArray[np.int64]:
    values = table[name].to_numpy()
    if values.dtype == np.uint64 and (values >= 2**63).any():
        raise CorrespondenceError(f"column {name!r} holds a number beyond 64 bits")
    return np.asarray(values, dtype=np.int64)


def load_camera_matches(path: Path | str) -> CameraMatches:
    """Read a table from Parquet, or from CSV with the same columns.

    Raises:
        FileError: if the file is missing or truncated, lacks a column, or holds a wrong value.
    """
    path = require_file(Path(path))
    types = {"frame": "int64"} | dict.fromkeys((*NUMBERS, *PLANES), "float64")
    table = read_arrow(path, NAMES, types)
    try:
        return _from_arrow(table, path)
    except (CorrespondenceError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise FileError(path, f"holds a wrong value: {error}") from error


def _from_arrow(table: pa.Table, path: Path) -> CameraMatches:
    given, metadata = table.column_names, table.schema.metadata or {}
    if sorted(given) != sorted(COLUMNS):
        missing = [name for name in COLUMNS if name not in given]
        what = f"column {missing[0]!r} is missing" if missing else "there are unknown columns"
        raise FileError(path, f"{what}; found {given}, expected {list(COLUMNS)}")
    if (form := metadata.get(b"format", FORMAT.encode())) != FORMAT.encode():
        raise FileError(path, f"has the format {form!r}, expected {FORMAT!r}")
    require_no_nulls(table, (*NAMES, "frame", *NUMBERS))
    for name in NAMES:
        require_short_names(table[name])
    names = [table[name].to_pylist() for name in NAMES]
    stated = json.loads(metadata.get(b"cameras", b"null"))
    in_order = [name for row in zip(*names, strict=True) for name in row]
    cameras = tuple(stated or dict.fromkeys(in_order))
    number = {name: index for index, name in enumerate(cameras)}
    index = np.array([[number[name] for name in side] for side in names], np.int32).T

    return CameraMatches(
        cameras=cameras,
        camera_index=index.reshape(-1, 2),
        frame=np.asarray(table["frame"].to_numpy(), np.int64),
        pixels_px=_stack(table, NUMBERS).reshape(-1, 2, 2),
        planes_lidar_per_m=_stack(table, PLANES).reshape(-1, 2, 3),
        metadata=json.loads(metadata.get(b"matcher", b"{}")),
    )


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
