"""Tables of camera-camera matches from disk: Parquet, or CSV with the same columns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.files import require_file
from calibgraph.io.correspondence_tables import read_arrow, require_no_nulls, require_short_names
from calibgraph.model.camera_matches import (
    COLUMNS,
    FORMAT,
    NAMES,
    NUMBERS,
    PLANES,
    CameraMatches,
)

if TYPE_CHECKING:
    import pyarrow as pa


def load_camera_matches(path: Path | str) -> CameraMatches:
    """Read a table from Parquet, or from CSV with the same columns.

    Raises:
        FileError: if the file is missing or truncated, lacks a column, or holds a wrong value.
    """
    path = require_file(Path(path))
    types = {"frame": "int64"} | dict.fromkeys((*NUMBERS, *PLANES), "float64")
    table = read_arrow(path, NAMES, types)
    if (missing := [name for name in COLUMNS if name not in table.column_names]) or len(
        table.column_names
    ) > len(COLUMNS):
        what = f"column {missing[0]!r} is missing" if missing else "there are unknown columns"
        raise FileError(path, f"{what}; found {table.column_names}, expected {list(COLUMNS)}")
    form = (table.schema.metadata or {}).get(b"format", FORMAT.encode())
    if form.decode("utf-8", "replace") != FORMAT:
        raise FileError(path, f"has the format {form!r}, expected {FORMAT!r}")
    try:
        return _from_arrow(table)
    except (CorrespondenceError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise FileError(path, f"holds a wrong value: {error}") from error


def _from_arrow(table: pa.Table) -> CameraMatches:
    metadata = table.schema.metadata or {}
    require_no_nulls(table, (*NAMES, "frame", *NUMBERS))
    for name in NAMES:
        require_short_names(table[name])
    names = [table[name].to_pylist() for name in NAMES]
    given = json.loads(metadata.get(b"cameras", b"null"))
    in_order = [name for row in zip(*names, strict=True) for name in row]
    cameras = tuple(given or dict.fromkeys(in_order))
    number = {name: index for index, name in enumerate(cameras)}
    index = np.array([[number[name] for name in side] for side in names], np.int32).T

    def stack(columns: tuple[str, ...]) -> Array:
        return np.stack([np.asarray(table[name].to_numpy(), np.float64) for name in columns], 1)

    return CameraMatches(
        cameras=cameras,
        camera_index=index.reshape(-1, 2),
        frame=np.asarray(table["frame"].to_numpy(), np.int64),
        pixels_px=stack(NUMBERS).reshape(-1, 2, 2),
        planes_lidar_per_m=stack(PLANES).reshape(-1, 2, 3),
        metadata=json.loads(metadata.get(b"matcher", b"{}")),
    )
