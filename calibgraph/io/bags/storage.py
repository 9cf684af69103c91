"""Bags by their files: which library reads one, and the folder of a ROS 2 bag as one recording."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath

from calibgraph.errors import CalibrationError, FileError, in_words, needs_extra
from calibgraph.files import read_yaml
from calibgraph.io.bags.recording import Recording, topics_by_name

_METADATA, _HEAD_BYTES = "metadata.yaml", 1000
_REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover"}
_REPAIR_ROS2 = "ros2 bag reindex"


def is_bag(path: Path | str) -> bool:
    """Whether a path is a ROS 1 bag, a file of a ROS 2 bag or the folder of one."""
    path = Path(path)
    if path.suffix.lower() in (".bag", ".mcap", ".db3") and path.is_file():
        return True
    metadata = path / _METADATA
    if not metadata.is_file():
        return False
    with metadata.open("rb") as file:
        return b"rosbag2" in file.read(_HEAD_BYTES)


def open_recording(path: Path) -> Recording:
    """Open a bag by its suffix; of a folder, all files that its metadata.yaml names.

    Raises:
        CalibrationError: if a library is missing.
        FileError: if a file is missing, or was not closed.
        Exception: what the libraries raise for a damaged bag.
    """
    _require_closed(path)
    with needs_extra("ros", f"{path}: reading ROS bags needs rosbags and mcap"):
        from calibgraph.io.bags.mcap_files import McapFile
        from calibgraph.io.bags.rosbags_files import RosbagsFile
    if path.is_dir():
        files = _files_of(path)
        return BagFolder(files) if files else RosbagsFile(path)
    return McapFile(path) if path.suffix.lower() == ".mcap" else RosbagsFile(path)


class BagFolder:
    """The files of a ROS 2 bag one after another, as one recording."""

    def __init__(self, files: Collection[Path]) -> None:
        self._parts: list[Recording] = []
        try:
            for file in files:
                self._parts.append(open_recording(file))
        except BaseException:
            self.close()
            raise
        self._parts.sort(key=lambda part: part.start_ns)
        self.topics = topics_by_name(t for part in self._parts for t in part.topics.values())
        self.start_ns = min(part.start_ns for part in self._parts)
        self.stop_ns = max(part.stop_ns for part in self._parts)

    def close(self) -> None:
        """Close all files."""
        for part in self._parts:
            part.close()

    def messages(
        self, topics: Collection[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and bytes of the messages of some topics."""
        for part in self._parts:
            yield from part.messages(topics, start_ns, stop_ns)


def _files_of(folder: Path) -> list[Path]:
    """The files of a folder, of whichever storage; none if they are compressed."""
    stated = read_yaml(folder / _METADATA)["rosbag2_bagfile_information"]
    if (stated.get("compression_mode") or "none").lower() != "none":
        return []
    files = [folder / PurePath(name).name for name in stated["relative_file_paths"]]
    for file in files:
        if not file.is_file():
            raise FileError(
                folder,
                f"its {_METADATA} names {file.name}, which is not there; copy it there, or write "
                f"the metadata again with `{_REPAIR_ROS2}`",
            )
    return files


def _require_closed(path: Path) -> None:
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
        repair = _REPAIR.get(path.suffix.lower(), _REPAIR_ROS2)
        raise FileError(
            path,
            f"is truncated, was not closed or is no ROS bag ({in_words(error)}); "
            f"record or copy it again, or repair it with `{repair}`",
        ) from error
