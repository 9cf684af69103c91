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


def open_upload(upload: Path, target: Path, most_bytes: int) -> Path:
    """The recording in an upload, by its first bytes: linked, or unpacked into a folder.

    Args:
        upload: the file, which stays as it is.
        target: of the folder, or of the bag without its suffix.
        most_bytes: of all unpacked files.

    Raises:
        FileError: if it is neither, or an archive holds something else, or too much.
    """
    with upload.open("rb") as file:
        head = file.read(16)
    for mark, suffix in _BAGS.items():
        if head.startswith(mark):
            bag = target.with_name(target.name + suffix)
            bag.hardlink_to(upload)
            return bag
    if not head.startswith(_ZIP):
        raise FileError(target, "is no .zip of a dataset folder, and no bag (.bag, .mcap, .db3)")
    try:
        _unpack(upload, target, most_bytes)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise FileError(target, f"cannot be unpacked ({error}); make the .zip again") from error
    return target


def table_suffix(path: Path) -> str:
    """The suffix of an uploaded table by its first bytes: Parquet, else CSV."""
    with path.open("rb") as file:
        return ".parquet" if file.read(4) == b"PAR1" else ".csv"


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
                shutil.copyfileobj(source, file, 2**20)


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
    if left_out:
        named = ", ".join(ascii(target[:100]) for target in left_out[:20])
        print(f"{where}: {len(left_out)} files are no part of a dataset, and left out: {named}")
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
    most = min(most_bytes, max(_ANY_RATIO_BYTES, MOST_RATIO * packed))
    if size > most:
        why = f"{packed} bytes stand for {size} when unpacked, expected up to {most}"
        raise FileError(where, f"{why}; send a recording of a sensor, or less of it")


def _unexpected(name: str, where: str) -> FileError:
    return FileError(
        where,
        f"holds {ascii(name[:100])}, expected rig.yaml, lidar/STEM.npy, cameras/NAME/STEM.png, "
        "or a KITTI sequence or ROS 2 bag, with names of letters, digits, _, - and .",
    )
