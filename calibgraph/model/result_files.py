"""The files of a result in its folder, and which files there may be replaced by a new result.

No command removes or replaces what it reads, nor a file that is not recognised as written before.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from calibgraph.errors import FileError
from calibgraph.files import require_place_for_folder
from calibgraph.model.camera_matches import FORMAT as MATCHES_FORMAT
from calibgraph.model.table_columns import TABLE_FORMAT

CALIBRATION_FORMAT = "calibgraph-calibration/1"
CALIBRATION_FILE = "calibration.yaml"
CORRESPONDENCES_FILE = "correspondences.parquet"
CAMERA_MATCHES_FILE = "camera_matches.parquet"
REPORT_FILE = "report.html"
PICTURES = ("overlay_*.png", "track.png")

VERDICT_KEY = "verdict"
"""In the metadata of a table: it is part of a result."""


def require_place_for_result(folder: Path, *read: Path | None) -> None:
    """Check, before hours of work, that a result can be written without the loss of other files.

    Args:
        folder: of the result.
        read: the files that the command reads.

    Raises:
        FileError: if the folder cannot be written to, or if a file of a result's name in it is one
            that is read, or is not of an earlier result.
    """
    require_place_for_folder(folder)
    names = (CALIBRATION_FILE, CORRESPONDENCES_FILE, CAMERA_MATCHES_FILE, REPORT_FILE)
    pictures = [path for pattern in PICTURES for path in folder.glob(pattern)]
    for path in (*(folder / name for name in names), *pictures):
        require_not_read(path, read)
    require_replaceable(folder)
    if not (folder / CALIBRATION_FILE).is_file():
        for path in (folder / REPORT_FILE, *pictures):
            _refuse_if_there(path)


def require_replaceable(folder: Path) -> None:
    """Check that a calibration and its tables in a folder, if there are any, are of a result.

    Raises:
        FileError: if not: something else wrote them.
    """
    for name, is_of_result in (
        (CALIBRATION_FILE, is_calibration_file),
        (CORRESPONDENCES_FILE, is_table_of_result),
        (CAMERA_MATCHES_FILE, is_table_of_result),
    ):
        if not is_of_result(folder / name):
            _refuse_if_there(folder / name)


def require_replaceable_table(path: Path, read: Iterable[Path | None]) -> None:
    """Check that a table to write replaces nothing but a table that is not of a result.

    Args:
        path: of the table, .parquet or .csv.
        read: the files that the command reads.

    Raises:
        FileError: if it is one of those that are read, or of a result, or no table of this format.
    """
    require_not_read(path, read)
    if path.suffix == ".parquet" and path.exists():
        metadata = _table_metadata(path)
        if metadata is None or VERDICT_KEY in metadata:
            raise FileError(path, "is part of a result or no table of correspondences, and would "
                            "be replaced; choose another --out")  # fmt: skip


def require_not_read(path: Path, read: Iterable[Path | None]) -> None:
    """Check that a file to write is none of those that are read.

    Raises:
        FileError: if it is.
    """
    for other in read:
        if other is not None and path.exists() and other.exists() and path.samefile(other):
            raise FileError(path, "is read by this command, which would replace it; "
                            "choose another --out")  # fmt: skip


def is_calibration_file(path: Path) -> bool:
    """Whether a file is a result's, by its first line."""
    start = f"format: {CALIBRATION_FORMAT}\n".encode()
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(start)) == start


def is_table_of_result(path: Path) -> bool:
    """Whether a Parquet file is the table of a result, by its metadata."""
    return VERDICT_KEY in (_table_metadata(path) or ())


def _table_metadata(path: Path) -> Any:
    """What a Parquet file's matcher reported; None if it is no table of this program."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        metadata = parquet.read_schema(path).metadata or {}
        known = metadata.get(b"format", b"").decode() in (TABLE_FORMAT, MATCHES_FORMAT)
        return json.loads(metadata.get(b"matcher", b"{}")) if known else None
    except (pa.ArrowException, OSError, ValueError, TypeError, RecursionError):
        return None


def _refuse_if_there(path: Path) -> None:
    if path.exists():
        raise FileError(
            path, "is not of an earlier result and would be replaced; move it, or choose another "
            "--out"
        )  # fmt: skip
