"""Bags by their files: which library reads one, and the folder of a ROS 2 bag as one recording."""

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from operator import itemgetter
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory

from calibgraph.errors import CalibrationError, FileError, in_words, needs_extra
from calibgraph.files import read_yaml
from calibgraph.io.bags.recording import Recording, topics_by_name
from calibgraph.io.bags.unpacking import unpack, unpack_file

_METADATA, _HEAD_BYTES = "metadata.yaml", 1000
_SUFFIXES = (".bag", ".mcap", ".db3")
_UNPACK = {".gz": "gunzip", ".bz2": "bunzip2", ".xz": "unxz", ".lz4": "unlz4", ".zst": "unzstd",
           ".zstd": "unzstd", ".zip": "unzip", ".7z": "7z x"}  # fmt: skip
_REPAIR = {".bag": "rosbag reindex", ".mcap": "mcap recover"}
_REPAIR_ROS2 = "ros2 bag reindex"


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
    metadata = path / _METADATA
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
    if last in _UNPACK:
        raise FileError(path, f"is compressed: unpack it first with `{_UNPACK[last]} {path.name}`")


def open_recording(path: Path) -> Recording:
    """Open a bag by its suffix; of a folder, all files that its metadata.yaml names.

    Raises:
        CalibrationError: if a library is missing.
        FileError: if a file is missing, or was not closed.
        Exception: what the libraries raise for a damaged bag.
    """
    _require_closed(path)
    with needs_extra("ros", f"{path}: reading ROS bags needs rosbags and mcap"):
        from calibgraph.io.bags.db3_files import Db3File
        from calibgraph.io.bags.mcap_files import McapFile
        from calibgraph.io.bags.ros1_files import Ros1File
    if path.is_dir():
        return BagFolder(path)
    kinds: dict[str, Callable[[Path], Recording]] = {".bag": Ros1File, ".mcap": McapFile}
    return kinds.get(path.suffix.lower(), Db3File)(path)


class BagFolder:
    """The files of a ROS 2 bag as one recording, of whichever storage and compression."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        stated = read_yaml(folder / _METADATA)["rosbag2_bagfile_information"]
        self._mode = (stated.get("compression_mode") or "none").lower()
        with ExitStack() as opened:
            self._parts: list[Recording] = []
            for file in _files_of(folder, stated["relative_file_paths"]):
                self._parts.append(open_recording(self._unpacked(file, opened)))
                opened.callback(self._parts[-1].close)
            self.topics = topics_by_name(t for part in self._parts for t in part.topics.values())
            self.close = opened.pop_all().close

    def _unpacked(self, file: Path, opened: ExitStack) -> Path:
        """The file or, where files are compressed, a copy that is not, until the bag is closed."""
        if self._mode != "file":
            return file
        copy = Path(opened.enter_context(TemporaryDirectory())) / file.stem
        unpack_file(file, copy)
        return copy

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of recording [ns] and bytes of the messages of some topics, by time."""
        parts = (part.messages(topics, start_ns, stop_ns) for part in self._parts)
        kind = "zstd" if self._mode == "message" else ""
        for topic, record_ns, data in heapq.merge(*parts, key=itemgetter(1)):
            yield topic, record_ns, bytes(unpack(self._folder, kind, data))


def _files_of(folder: Path, stated: Iterable[str]) -> list[Path]:
    """The files of a folder."""
    files = [folder / PurePath(name).name for name in stated]
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
