"""Uploads as datasets: an archive of a dataset folder, or a bag. Names are checked, never paths."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import IO

from calibgraph.errors import FileError

MOST_FILES = 100_000
_CHUNK = 2**20
_NAME = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}"
_LAYOUT = re.compile(
    rf"(?:rig\.yaml|calib\.txt|times\.txt|metadata\.yaml|{_NAME}\.(?:db3|mcap)"
    rf"|(?:lidar|velodyne|image_[0-9])/{_NAME}|cameras/{_NAME}/{_NAME})"
)
"""What an archive may hold: a dataset folder, a KITTI odometry sequence, or a ROS 2 bag."""

_BAGS = {b"#ROSBAG V2.0": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
_ZIP = b"PK\x03\x04"
_TABLES = {b"PAR1": ".parquet"}


def open_upload(path: Path, most_bytes: int) -> Path:
    """The recording in an upload: what it is, its first bytes show.

    Args:
        path: of the uploaded file.
        most_bytes: of an archive, unpacked.

    Returns:
        A folder or a bag beside it, in whose place it is.

    Raises:
        FileError: if it is neither, or an archive holds something else, or too much.
    """
    with path.open("rb") as file:
        head = file.read(16)
    for mark, suffix in _BAGS.items():
        if head.startswith(mark):
            return path.rename(path.with_name(path.name + suffix))
    if not head.startswith(_ZIP):
        raise FileError(path.name, "is no .zip of a dataset folder, and no bag (.bag, .mcap, .db3)")
    packed = path.rename(path.with_name(path.name + ".packed"))
    try:
        _unpack(packed, path, most_bytes)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise FileError(path.name, f"cannot be unpacked ({error}); make the .zip again") from error
    packed.unlink()
    return path


def table_suffix(path: Path) -> str:
    """The suffix of an uploaded table by its first bytes: Parquet, else CSV."""
    with path.open("rb") as file:
        head = file.read(4)
    return _TABLES.get(head, ".csv")


def _unpack(packed: Path, folder: Path, most_bytes: int) -> None:
    """Unpack an archive; what it says of its sizes is not believed."""
    folder.mkdir()
    with zipfile.ZipFile(packed) as archive:
        members = [member for member in archive.infolist() if not member.is_dir()]
        if len(members) > MOST_FILES:
            raise FileError(folder.name, f"{len(members)} files, expected up to {MOST_FILES}")
        names = [member.filename for member in members]
        for name in names:
            if not _LAYOUT.fullmatch(name):
                raise FileError(
                    folder.name,
                    f"holds {ascii(name[:100])}, expected rig.yaml, lidar/STEM.npy, "
                    "cameras/NAME/STEM.png, or a KITTI sequence or ROS 2 bag, with names of "
                    "letters, digits, _, - and .",
                )
        if len({name.lower() for name in names}) < len(names):
            raise FileError(folder.name, "holds a name twice")
        left = most_bytes
        for member in members:
            target = folder / member.filename
            target.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(member) as source, target.open("xb") as file:
                left = _copy(source, file, left, folder.name, most_bytes)


def _copy(source: IO[bytes], target: IO[bytes], left: int, name: str, most_bytes: int) -> int:
    """Copy a file; the bytes that others may have after it."""
    while chunk := source.read(_CHUNK):
        left -= len(chunk)
        if left < 0:
            raise FileError(name, f"holds over {most_bytes} bytes when unpacked; send less")
        target.write(chunk)
    return left
