"""Bags by their files, which the libraries of the extra ``ros`` read."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath

from calibgraph.errors import CalibrationError, FileError, in_words

METADATA, REPAIR_ROS2 = "metadata.yaml", "ros2 bag reindex"
_HEAD_BYTES = 1000
_SUFFIXES = (".bag", ".mcap", ".db3")
UNPACK = {".gz": "gunzip", ".bz2": "bunzip2", ".xz": "unxz", ".lz4": "unlz4", ".zst": "unzstd",
           ".zstd": "unzstd", ".zip": "unzip", ".7z": "7z x"}  # fmt: skip
_REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover"}


@dataclass(frozen=True)
class Topic:
    """A topic of a bag; the type names the encoding if that is none of ROS."""

    name: str
    type: str
    count: int
    encoding: str = "cdr"


def is_bag(path: Path | str) -> bool:
    """Whether a path is a ROS 1 bag, a file of a ROS 2 bag or the folder of one.

    Raises:
        FileError: if it is the file of a bag that was not closed, or is compressed as a whole.
    """
    path = Path(path)
    if path.suffix.lower() in _SUFFIXES and path.is_file():
        return True
    if PurePath(path.stem).suffix.lower() in _SUFFIXES and path.is_file():
        _refuse_as_it_is(path)
    metadata = path / METADATA
    if not metadata.is_file():
        return False
    with metadata.open("rb") as file:
        return b"rosbag2" in file.read(_HEAD_BYTES)


def _refuse_as_it_is(path: Path) -> None:
    """Refuse a file that would be a bag under its name without the last suffix."""
    last = path.suffix.lower()
    if last == ".active":
        raise FileError(
            path,
            "was not closed by the recorder: mend it with `rosbag reindex`, then rename it to "
            f"{path.stem}",
        )
    if last in UNPACK:
        raise FileError(path, f"is compressed: unpack it first with `{UNPACK[last]} {path.name}`")


def require_closed(path: Path) -> None:
    """Check that a database's messages are all in its file: a recorder that crashed leaves some."""
    for log in (path.parent if path.is_file() else path).glob("*.db3-wal"):
        if log.stat().st_size and (path.is_dir() or log.name == f"{path.name}-wal"):
            raise FileError(
                path,
                f"was not closed: {log.name} holds messages that are not yet in it; close it with "
                f"`sqlite3 {log.name.removesuffix('-wal')} 'pragma wal_checkpoint(truncate)'`",
            )


@contextmanager
def errors_in_one_line(path: Path) -> Iterator[None]:
    """Raise what a damaged bag makes the parsers raise, which may be anything, as FileError."""
    try:
        yield
    except (CalibrationError, PermissionError):
        raise
    except Exception as error:
        repair = _REPAIR.get(path.suffix.lower(), REPAIR_ROS2)
        raise FileError(
            path,
            f"is truncated, was not closed or is no ROS bag ({in_words(error)}); "
            f"record or copy it again, or repair it with `{repair}`",
        ) from error
