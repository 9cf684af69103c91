"""Point clouds from disk, as x y z intensity: .npy, .bin, .pcd, .ply, .las, .laz, .feather."""

from __future__ import annotations

import threading
import tokenize
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError, in_words
from calibgraph.files import require_file
from calibgraph.io.bags import MESSAGE_SUFFIX, load_bag_cloud
from calibgraph.io.feather import read_feather
from calibgraph.io.las import read_las
from calibgraph.io.motion import ScanMotion
from calibgraph.io.pcd_ply import read_pcd_or_ply
from calibgraph.model.correspondences import MAX_COORDINATE

Points = tuple[NDArray[Any], NDArray[Any] | None]
"""(n, 3) x y z and (n,) intensities, None if there are none; in any type of number."""

MAX_CLOUD_BYTES = 2 * 2**30

_PARSER = threading.Lock()
"""numpy reads headers by Python's parser, which in 3.11 raises SystemError if another thread parses
in the midst of it."""

_UNREADABLE = (
    ValueError, TypeError, OSError, EOFError, MemoryError, OverflowError, RecursionError,
    SyntaxError, tokenize.TokenError, zipfile.BadZipFile,
)  # fmt: skip
"""Of numpy, which takes the header of a file as Python, and memory for all that it claims."""

_XYZ, _XYZI = 3, 4
_NUSCENES = ".pcd.bin"
_MOST_COLUMNS = 64


def load_cloud(path: Path | str, motion: ScanMotion | None = None) -> NDArray[np.float32]:
    """Read a cloud.

    Args:
        path: a .npy array (n, 3) or (n, 4+), a KITTI .bin (float32 x y z intensity), a nuScenes
            .pcd.bin (and the ring), .pcd, .ply, .las, .laz, or a .feather of Argoverse 2; or the
            address of a message in a bag.
        motion: for which points of a bag's message are corrected; None for none.

    Returns:
        (n, 4) x y z [m] in the LiDAR frame and the intensity as the file has it, NaN where it has
        none. Rows whose x, y and z are all NaN ("no return" in organised clouds) are left out.

    Raises:
        FileError: if the file is missing, truncated, empty, of another format, or has values that
            are not finite.
    """
    path = Path(path)
    if path.suffix == MESSAGE_SUFFIX:
        return load_bag_cloud(path, motion)
    if require_file(path).stat().st_size > MAX_CLOUD_BYTES:
        raise FileError(path, f"{path.stat().st_size} bytes is too large for one cloud")
    if path.suffix.lower() not in _READERS:
        raise FileError(path, f"unknown cloud format; known are {', '.join(CLOUD_SUFFIXES)}")
    return check_points(with_intensity(*_READERS[path.suffix.lower()](path)), path)


def check_points(cloud: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    """The rows of a cloud (n, 4) with a return.

    Args:
        cloud: with NaN in x, y and z where there is none.
        path: of the cloud, or its name.

    Raises:
        FileError: if there is no point, or one is not finite.
    """
    returned = cloud[~np.isnan(cloud[:, :3]).all(axis=1)]
    if not len(returned):
        raise FileError(path, "holds no point")
    with np.errstate(invalid="ignore"):  # random bytes are numbers that warn
        finite = np.isfinite(returned[:, :3])
        largest = np.abs(returned[:, :3]).max(where=finite, initial=0.0)
    if finite.all() and not largest:
        raise FileError(path, f"all of its {len(returned)} points lie at the origin")
    if not finite.all():
        bad = ~np.isfinite(cloud[:, :3]).all(axis=1) & ~np.isnan(cloud[:, :3]).all(axis=1)
        row = int(np.flatnonzero(bad)[0])
        raise FileError(
            path,
            f"point {row} is not finite: {cloud[row, :3].tolist()}; record again, or mark points "
            "without a return by NaN in x, y and z",
        )
    if largest > MAX_COORDINATE:
        raise FileError(
            path,
            f"holds a coordinate of {largest:.3g}, expected metres, up to {MAX_COORDINATE:g}; "
            "convert its unit, or mark points without a return by NaN in x, y and z",
        )
    return returned


def _read_npy(path: Path) -> Points:
    try:
        with _PARSER, path.open("rb") as file:  # numpy leaves it open if it is no whole archive
            array = np.load(file, allow_pickle=False)
    except _UNREADABLE as error:
        raise FileError(
            path, f"cannot be read as a .npy array ({in_words(error)}); is it complete?"
        ) from None
    if not isinstance(array, np.ndarray):
        raise FileError(path, "is an archive of arrays, expected one array; write it with np.save")
    if array.ndim != 2 or array.shape[1] < _XYZ or array.dtype.kind not in "fiu":  # noqa: PLR2004
        raise FileError(
            path, f"has shape {array.shape} of {array.dtype}, expected (n, 3) or (n, 4) numbers"
        )
    if array.shape[1] > _MOST_COLUMNS:
        raise FileError(path, f"has {array.shape[1]} columns, expected 3 or 4; is it transposed?")
    return array[:, :3], array[:, 3] if array.shape[1] >= _XYZI else None


def _read_bin(path: Path) -> Points:
    size = path.stat().st_size
    columns = ["x", "y", "z", "intensity"]
    columns += ["ring"] * path.name.lower().endswith(_NUSCENES)
    if size % (4 * len(columns)):
        raise FileError(
            path,
            f"{size} bytes is not a whole number of float32 {' '.join(columns)}; is it complete?",
        )
    points = np.fromfile(path, dtype="<f4").reshape(-1, len(columns))
    return points[:, :3], points[:, 3]


def with_intensity(
    xyz: NDArray[np.floating], intensity: NDArray[np.floating] | None
) -> NDArray[np.float32]:
    """(n, 4) float32 of (n, 3) points and (n,) intensities, NaN if there are none."""
    cloud = np.full((len(xyz), 4), np.nan, dtype=np.float32)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused as such
        cloud[:, :3] = xyz
        if intensity is not None:
            cloud[:, 3] = intensity
    return cloud


def _read_sweep(path: Path) -> Points:
    """Of Argoverse 2."""
    columns = read_feather(path, ("x", "y", "z"), optional=("intensity",))
    return np.column_stack([columns[axis] for axis in "xyz"]), columns.get("intensity")


_READERS: dict[str, Callable[[Path], Points]] = {
    ".npy": _read_npy, ".bin": _read_bin, ".pcd": read_pcd_or_ply, ".ply": read_pcd_or_ply,
    ".las": read_las, ".laz": read_las, ".feather": _read_sweep,
}  # fmt: skip
CLOUD_SUFFIXES = tuple(_READERS)
