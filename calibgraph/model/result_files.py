"""The files of a result in its folder, and the marks by which they are recognised."""

from pathlib import Path

from calibgraph.outputs import PAGE_MARK, Output, is_marked

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
WRITTEN_KEY, MATCH, RESULT = "written_by", "calibgraph match", "calibgraph calibrate"
"""In the metadata of a table: the command that wrote it."""

_CALIBRATION_MARK = f"format: {CALIBRATION_FORMAT}\n".encode()
_TABLE_MARK = f'"{VERDICT_KEY}": '.encode()


def outputs_of_result(folder: Path) -> list[Output]:
    """The files of a result in a folder: its pictures are those there, if a result is there."""
    calibration = folder / CALIBRATION_FILE
    pictures = [path for pattern in PICTURES for path in sorted(folder.glob(pattern))]
    return [
        *outputs_of_calibration(folder),
        Output(folder / REPORT_FILE, _BY, (PAGE_MARK,)),
        *(Output(path, _BY, (_CALIBRATION_MARK,), marked=calibration) for path in pictures),
    ]


def outputs_of_calibration(folder: Path) -> list[Output]:
    """The calibration and its tables in a folder."""
    return [
        Output(folder / CALIBRATION_FILE, _BY, (_CALIBRATION_MARK,)),
        Output(folder / CORRESPONDENCES_FILE, _BY, (_TABLE_MARK,)),
        Output(folder / CAMERA_MATCHES_FILE, _BY, (_TABLE_MARK,)),
    ]


def is_calibration_file(path: Path) -> bool:
    """Whether a file is a result's."""
    return is_marked(path, _CALIBRATION_MARK)


def table_mark(command: str) -> bytes:
    """The part of a table's metadata that names the command which wrote it."""
    return f'"{WRITTEN_KEY}": "{command}"'.encode()
