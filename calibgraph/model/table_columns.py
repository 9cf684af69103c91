"""The columns of a correspondence table: their names and types on disk, the writer, their rows."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.files import write_atomically

if TYPE_CHECKING:
    import pyarrow as pa

TABLE_FORMAT = "calibgraph-correspondences/1"

COORDINATES = ("u_px", "v_px", "x_m", "y_m", "z_m")
INFORMATION = ("i_uu_px", "i_uv_px", "i_vv_px")
TWIST = ("wx_rad_s", "wy_rad_s", "wz_rad_s", "vx_m_s", "vy_m_s", "vz_m_s")
MAX_TWIST = 6.0, 100.0  # rad/s and m/s: beyond those of a vehicle; swapped ones are seen
TWIST_RULE = "be under 6 rad/s, then under 100 m/s (rotation first, in radians)"

MIN_INFORMATION, MAX_INFORMATION = 1e-12, 1e8  # 1/px^2: errors from 1e6 px down to 1e-4 px

OPTIONAL_WHOLE = ("stamp_ns", "point_index")
_WHOLE = ("frame", *OPTIONAL_WHOLE)
_REQUIRED = ("camera", "frame", *COORDINATES)
_COLUMNS = (*_REQUIRED, "confidence", *OPTIONAL_WHOLE, *INFORMATION, *TWIST)
_TEXT = ("string", "large_string", "string_view", "binary", "large_binary")

WITHOUT_METADATA = (
    "CSV holds no metadata, so that places, errors that frames share and what the images said "
    "(calibgraph_images) are not known; .parquet keeps them"
)

_log = logging.getLogger(__name__)


def check_whole(name: str, values: ArrayLike | None) -> None:
    """Check that a column holds whole numbers of 64 bits, if there is one.

    Raises:
        CorrespondenceError: if it does not.
    """
    array = np.asarray([] if values is None else values)
    if array.size and array.dtype.kind not in "iu":
        raise CorrespondenceError(f"{name} must hold whole numbers, found {values!r}")
    if array.size and array.max() >= 2**63:
        raise CorrespondenceError(f"{name} holds a number beyond 64 bits")


def is_information(uu_uv_vv: Array) -> NDArray[np.bool_]:
    """(n,) whether (n, 3) i_uu, i_uv, i_vv are positive semidefinite matrices and not zero."""
    uu, uv, vv = uu_uv_vv.T
    determinant, tolerance = uu * vv - uv**2, 1e-6 * np.maximum(uu, vv) ** 2
    positive = (uu >= 0) & (vv >= 0) & (determinant >= -tolerance)
    good: NDArray[np.bool_] = positive & (uu + vv > MIN_INFORMATION)
    return good


def beyond_vehicles(twist_per_s: Array) -> NDArray[np.bool_]:
    """(n,) whether (n, 6) motions are those of no vehicle."""
    lengths = np.linalg.norm(twist_per_s.reshape(-1, 2, 3), axis=2)
    beyond: NDArray[np.bool_] = (lengths >= MAX_TWIST).any(axis=1)
    return beyond


def write_table(arrow: pa.Table, path: Path) -> None:
    """Write a table as Parquet, or as CSV if the name ends in .csv, atomically.

    A warning is logged where CSV loses the metadata of a matcher.
    """
    from pyarrow import csv, parquet

    def write(part: Path) -> None:
        if path.suffix == ".csv":
            csv.write_csv(arrow, part)
        else:
            parquet.write_table(arrow, part, write_page_checksum=True)

    write_atomically(path, write)
    said = (arrow.schema.metadata or {}).get(b"matcher", b"{}")
    if path.suffix == ".csv" and said != b"{}":
        _log.warning("%s: %s", path, WITHOUT_METADATA)


def check_schema(schema: pa.Schema) -> None:
    """Check that a table has the columns and the format of the file, each of a right type.

    Raises:
        CorrespondenceError: with the first thing that is wrong.
    """
    try:
        types = [(field.name, str(field.type)) for field in schema]
    except UnicodeDecodeError as error:
        raise CorrespondenceError(f"a column's name is not UTF-8 ({error}); rename it") from error
    names = [name for name, _ in types]
    missing = [name for name in _REQUIRED if name not in names]
    unknown = [name for name in names if name not in _COLUMNS]
    if missing:
        raise CorrespondenceError(f"column {missing[0]!r} is missing; found {names}")
    if unknown:
        raise CorrespondenceError(f"unknown column {unknown[0]!r}; known are {', '.join(_COLUMNS)}")
    if len(set(names)) < len(names):
        raise CorrespondenceError(f"has a column twice: {names}; keep one")
    for group in (INFORMATION, TWIST):
        partial = [name for name in group if name in names]
        if partial and len(partial) < len(group):
            raise CorrespondenceError(f"has only {partial} of the columns {list(group)}")
    form = (schema.metadata or {}).get(b"format", TABLE_FORMAT.encode()).decode("utf-8", "replace")
    if form != TABLE_FORMAT:
        raise CorrespondenceError(f"has the format {form!r}, expected {TABLE_FORMAT!r}")
    for field in schema:
        _check_type(field)


def _check_type(field: pa.Field) -> None:
    """Check that a column has a plain type, whose size in memory is the size of the data.

    A few bytes of run-end encoded values, for example, could expand to any number of rows.
    """
    from pyarrow import types

    if types.is_null(field.type):
        raise CorrespondenceError(f"column {field.name!r} is empty; fill in or drop it")
    if field.name == "camera":
        named = field.type.value_type if types.is_dictionary(field.type) else field.type
        kind, right = "text", str(named) in _TEXT or types.is_integer(named)
    elif field.name in _WHOLE:
        kind, right = "whole numbers", types.is_integer(field.type)
    else:
        kind, right = "numbers", types.is_integer(field.type) or types.is_floating(field.type)
    if not right:
        raise CorrespondenceError(f"column {field.name!r} must hold {kind}, found {field.type}")


def as_confidence(values: ArrayLike) -> NDArray[np.float32]:
    """Confidences in single precision; larger numbers become infinite, which is refused later."""
    with np.errstate(over="ignore"):
        return np.asarray(values, dtype=np.float32)


def rows_where(mask: NDArray[np.bool_]) -> NDArray[np.int64] | slice:
    """The rows of a mask; a slice, which makes a view, where they follow each other."""
    first, count = int(mask.argmax()) if len(mask) else 0, int(np.count_nonzero(mask))
    if mask[first : first + count].all():
        return slice(first, first + count)
    return np.flatnonzero(mask)
