"""Bags by their files, and what is read of them."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from shlex import quote
from types import MappingProxyType
from typing import Literal, get_args

from calibgraph.errors import CalibrationError, FileError, in_words
from calibgraph.io.frame_files import way_out

METADATA, REPAIR_ROS2 = "metadata.yaml", "ros2 bag reindex {}"
_HEAD_BYTES = 1000
_SUFFIXES = (".bag", ".mcap", ".db3")
_REPAIR = {".bag": "rosbag reindex {}", ".mcap": "mcap recover {} -o whole.mcap"}


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
    if (
        PurePath(path.stem).suffix.lower() in _SUFFIXES
        and path.is_file()
        and (way := way_out(path))
    ):
        raise FileError(path, way)
    metadata = path / METADATA
    if not metadata.is_file():
        return False
    with metadata.open("rb") as file:
        return b"rosbag2" in file.read(_HEAD_BYTES)


def require_closed(path: Path) -> None:
    """Check that a database's messages are all in its file: a recorder that crashed leaves some."""
    for log in (path.parent if path.is_file() else path).glob("*.db3-wal"):
        if log.stat().st_size and (path.is_dir() or log.name == f"{path.name}-wal"):
            raise FileError(
                path,
                f"was not closed: {log.name} holds messages that are not yet in it; close it with "
                f"`sqlite3 {quote(f'{log}'[:-4])} 'pragma wal_checkpoint(truncate)'`",
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
        bag = path.parent if repair == REPAIR_ROS2 and path.is_file() else path
        raise FileError(
            path,
            f"is truncated, was not closed or is no ROS bag ({in_words(error)}); "
            f"record or copy it again, or repair it with `{repair.format(quote(str(bag)))}`",
        ) from error


Stamps = Literal["header", "record"]
Motion = Literal["none", "odometry", "tf", "scans"]
NEAR_S = 0.05
"""Largest difference of the stamps of a cloud and its images, if none is given: half a turn of a
LiDAR at 10 Hz, so that streams of equal rates pair, whatever their phase."""
LIDAR, ODOMETRY = "lidar", "odometry"
"""The keys of the clouds' topic and of the odometry's in :attr:`BagOptions.topics`."""


@dataclass(frozen=True, kw_only=True)
class BagOptions:
    """What is read of a bag.

    Attributes:
        topics: the clouds' topic under ``lidar``, and image topics by camera name,
            and that of the ``odometry``; those that are
            not given are found by their types.
        every_s: seconds between frames; only their surroundings are read. All frames if None.
        sync_tolerance_s: largest difference of the stamps of a cloud and its images, also of
            folders whose files are named by stamps.
        stamps: ``header``, those of the sensors; or ``record``, when a message was recorded, for
            sensors whose clocks differ.
        motion: how clouds are corrected for the motion of the vehicle, to the median stamp of a
            frame's images: by Odometry, by /tf, by registration of neighbouring scans; or
            ``none``: they are as recorded, or corrected already.
        beside: further bags of the drive, whose static transforms and lenses serve where the bag
            has none: those that are loaded together with it.

    Raises:
        ValueError: if a value is out of range.
    """

    topics: Mapping[str, str] = field(default_factory=dict)
    every_s: float | None = None
    sync_tolerance_s: float = NEAR_S
    stamps: Stamps = "header"
    motion: Motion = "none"
    beside: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "topics", MappingProxyType(dict(self.topics)))
        if self.every_s is not None and not self.every_s > 0:
            raise ValueError(f"every_s must be positive, found {self.every_s}")
        if not self.sync_tolerance_s >= 0:
            raise ValueError(
                f"sync_tolerance_s must not be negative, found {self.sync_tolerance_s}"
            )
        if self.stamps not in get_args(Stamps):
            raise ValueError(f"stamps {self.stamps!r}: known are {', '.join(get_args(Stamps))}")
        if self.motion not in get_args(Motion):
            raise ValueError(f"motion {self.motion!r}: known are {', '.join(get_args(Motion))}")
        if self.motion != "none" and self.stamps != "header":
            raise ValueError("motion is corrected by the stamps of the headers; leave out stamps")
