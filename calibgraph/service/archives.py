"""Uploads as datasets: an archive of a dataset folder, or a bag. Names are checked, never paths."""

import os
import re
import shutil
import zipfile
from pathlib import Path

from calibgraph.errors import FileError

MOST_FILES = 100_000
MOST_RATIO = 100
"""Clouds and images of sensors pack to a third at best; zeros to a thousandth."""
_ANY_RATIO_BYTES = 10**8
_MOST_NOTES = 20
_CHUNK = 2**20
_NAME = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}"
_LAYOUT = re.compile(
    rf"(?:rig\.yaml|calib\.txt|times\.txt|metadata\.yaml|{_NAME}\.(?:db3|mcap)"
    rf"|(?:lidar|velodyne|image_[0-9])/{_NAME}|cameras/{_NAME}/{_NAME})"
)
"""What an archive may hold: a dataset folder, a KITTI odometry sequence, or a ROS 2 bag."""

_DATA = re.compile(r"(?:lidar|velodyne|image_[0-9]|cameras)/")
"""Folders in which nothing is left out."""

_JUNK = re.compile(
    r"(?:.*/)?(?:__MACOSX/.*|\.DS_Store|\._[^/]*|Thumbs\.db|desktop\.ini)", re.IGNORECASE
)
"""What file managers add."""

_BAGS = {b"#ROSBAG V2.0": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
_ZIP = b"PK\x03\x04"
_TABLES = {b"PAR1": ".parquet"}


def open_upload(path: Path, most_bytes: int) -> Path:
    """The recording in an upload, by its first bytes: a bag or the unpacked folder, in its place.

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
    """Unpack an archive, if all its names and sizes are as they should be."""
    with zipfile.ZipFile(packed) as archive:
        files = [m for m in archive.infolist() if not m.is_dir()]
        if len(files) > MOST_FILES:
            raise FileError(folder.name, f"{len(files)} files, expected up to {MOST_FILES}")
        files = [m for m in files if not _JUNK.fullmatch(m.filename)]
        targets = _targets([m.filename for m in files], folder.name)
        size = sum(m.file_size for m in files)  # zipfile reads no more than that
        _require_size(size, packed.stat().st_size, folder.name, most_bytes)
        folder.mkdir()
        for name, target in targets.items():
            path = folder / target
            path.parent.mkdir(parents=True, exist_ok=True)
            with archive.open(name) as source, path.open("xb") as file:
                shutil.copyfileobj(source, file, _CHUNK)


def _targets(names: list[str], where: str) -> dict[str, str]:
    """Where files of an archive belong in the dataset's folder, which may be in other folders."""
    for name in names:
        if not name.isprintable() or "\\" in name or {"", ".", ".."} & {*name.split("/")}:
            raise _unexpected(name, where)
    top = _top_folder(names)
    targets = {name: name.removeprefix(top) for name in names}
    left_out = [target for target in targets.values() if not _LAYOUT.fullmatch(target)]
    for target in left_out:
        if _DATA.match(target) or len(left_out) == len(targets):
            raise _unexpected(target, where)
    for target in left_out[:_MOST_NOTES]:
        print(f"{where}: {ascii(target[:100])} is no part of a dataset and is left out")
    if len(left_out) > _MOST_NOTES:
        print(f"{where}: {len(left_out)} files are left out in all")
    kept = {name: target for name, target in targets.items() if _LAYOUT.fullmatch(target)}
    if len({name.lower() for name in names}) < len(names):
        raise FileError(where, "holds a name twice")
    return kept


def _top_folder(names: list[str]) -> str:
    """The folder in an archive that holds the dataset: the one in which most names fit."""
    shared = os.path.commonpath([f"/{name}" for name in names]) if names else "/"
    parts = [f"{part}/" for part in shared.split("/") if part]
    folders = ["".join(parts[:depth]) for depth in range(len(parts) + 1)]
    fits = [sum(bool(_LAYOUT.fullmatch(n.removeprefix(top))) for n in names) for top in folders]
    return folders[fits.index(max(fits))]


def _require_size(size: int, packed: int, where: str, most_bytes: int) -> None:
    if size > most_bytes:
        raise FileError(
            where, f"holds {size} bytes when unpacked, expected up to {most_bytes}; send less"
        )
    if size > max(_ANY_RATIO_BYTES, MOST_RATIO * packed):
        raise FileError(
            where,
            f"{packed} bytes stand for {size} when unpacked, over {MOST_RATIO} times as many; "
            "send a recording of a sensor",
        )


def _unexpected(name: str, where: str) -> FileError:
    return FileError(
        where,
        f"holds {ascii(name[:100])}, expected rig.yaml, lidar/STEM.npy, cameras/NAME/STEM.png, "
        "or a KITTI sequence or ROS 2 bag, with names of letters, digits, _, - and .",
    )
