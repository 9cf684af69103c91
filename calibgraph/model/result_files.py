"""The files of a result in its folder, and the marks by which they are recognised."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from calibgraph.model.camera_matches import FORMAT as MATCHES_FORMAT
from calibgraph.model.table_columns import TABLE_FORMAT
from calibgraph.outputs import Output, starts_with

CALIBRATION_FORMAT = "calibgraph-calibration/1"
CALIBRATION_FILE = "calibration.yaml"
CORRESPONDENCES_FILE = "correspondences.parquet"
CAMERA_MATCHES_FILE = "camera_matches.parquet"
REPORT_FILE = "report.html"
_BY = "calibrate, solve or track"
OVERLAYS = "overlay_*.png"
PICTURES = (OVERLAYS, "track.png")

VERDICT_KEY = "verdict"
"""In the metadata of a table: it is part of a result."""

WRITTEN_KEY, MATCH = "written_by", "calibgraph match"
"""In the metadata of a table: the command that wrote it."""

PAGE_MARK = b'<meta name="generator" content="calibgraph">'
_HEAD_BYTES = 1000


def outputs_of_result(folder: Path) -> list[Output]:
    """The files of a result in a folder: its pictures are those there, if a result is there."""
    of_result = is_calibration_file(folder / CALIBRATION_FILE)
    pictures = [path for pattern in PICTURES for path in sorted(folder.glob(pattern))]
    return [
        *outputs_of_calibration(folder),
        Output(folder / REPORT_FILE, _BY, is_report),
        *(Output(path, _BY, lambda _: of_result) for path in pictures),
    ]


def outputs_of_calibration(folder: Path) -> list[Output]:
    """The calibration and its tables in a folder."""
    return [
        Output(folder / CALIBRATION_FILE, _BY, is_calibration_file),
        Output(folder / CORRESPONDENCES_FILE, _BY, is_table_of_result),
        Output(folder / CAMERA_MATCHES_FILE, _BY, is_table_of_result),
    ]


is_calibration_file = starts_with(f"format: {CALIBRATION_FORMAT}\n".encode())
"""Whether a file is a result's, by its first line."""


def has_page_mark(mark: bytes) -> Callable[[Path], bool]:
    """Whether a file is a page with a mark in its head."""

    def is_marked(path: Path) -> bool:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return mark in file.read(_HEAD_BYTES)

    return is_marked


is_report = has_page_mark(PAGE_MARK)
"""Whether a file is a page of a report, by its head."""


def written_by(command: str) -> Callable[[Path], bool]:
    """Whether a Parquet file is a table that a command wrote, and not part of a result."""

    def is_its_table(path: Path) -> bool:
        metadata = _table_metadata(path) or {}
        return metadata.get(WRITTEN_KEY) == command and VERDICT_KEY not in metadata

    return is_its_table


is_table_of_match = written_by(MATCH)
"""Whether a Parquet file was written by ``match``, and is not part of a result."""


def is_table_of_result(path: Path) -> bool:
    """Whether a Parquet file is the table of a result, by its metadata."""
    return VERDICT_KEY in (_table_metadata(path) or ())


def _table_metadata(path: Path) -> dict[str, Any] | None:
    """What a Parquet file's matcher reported; None if it is no table of this program."""
    import pyarrow as pa
    from pyarrow import parquet

    try:
        metadata = parquet.read_schema(path).metadata or {}
        known = metadata.get(b"format", b"").decode() in (TABLE_FORMAT, MATCHES_FORMAT)
        content = json.loads(metadata.get(b"matcher", b"{}")) if known else None
        return content if isinstance(content, dict) else None
    except (pa.ArrowException, OSError, ValueError, TypeError, RecursionError):
        return None
