"""The files of a result in its folder, and when they may be replaced."""

import re
from collections.abc import Iterable
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import require_own_folder, sha256

CALIBRATION_FORMAT = "calibgraph-calibration/1"
CALIBRATION_FILE = "calibration.yaml"
CORRESPONDENCES_FILE = "correspondences.parquet"
CAMERA_MATCHES_FILE = "camera_matches.parquet"
TABLES = CORRESPONDENCES_FILE, CAMERA_MATCHES_FILE
REPORT_FILE = "report.html"

VERDICT_KEY = "verdict"
"""In the metadata of a table: it is part of a result."""

_FORMAT_LINE = f"format: {CALIBRATION_FORMAT}\n".encode()
_HEAD_BYTES = 4096


def is_calibration_file(path: Path) -> bool:
    """Whether a file is a result's."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return _FORMAT_LINE in file.read(_HEAD_BYTES)


def require_result_folder(folder: Path, read: Iterable[Path] = ()) -> None:
    """Check, before hours of work, that a result may be written into a folder.

    Raises:
        FileError: as of :func:`calibgraph.files.require_own_folder`, if a file that would be
            replaced is read, or as of :func:`require_own_tables`.
    """
    read = [path for path in read if path.exists()]
    require_own_folder(folder, read)
    for path in (folder / name for name in (CALIBRATION_FILE, *TABLES)):
        if path.exists() and any(path.samefile(other) for other in read):
            raise FileError(
                path, "is read by this command, which would replace it; choose another --out"
            )
    require_own_tables(folder)


def require_own_tables(folder: Path) -> None:
    """Check that tables with the names of a result's are those that the result beside them names.

    Raises:
        FileError: if one is another.
    """
    calibration = folder / CALIBRATION_FILE
    known = calibration.read_bytes() if calibration.is_file() else b""
    for path in (folder / name for name in TABLES):
        key = re.escape(f"{path.stem}_sha256: ".encode())
        if path.exists() and not re.search(key + b"'?" + sha256(path).encode(), known):
            raise FileError(
                path, f"is not the table of a {CALIBRATION_FILE} beside it, and would be replaced; "
                "move it, or choose another folder"
            )  # fmt: skip
