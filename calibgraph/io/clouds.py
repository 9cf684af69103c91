"""Point clouds from disk: .npy, .bin, .pcd, .ply, .feather; and notes on them."""

import threading
import tokenize
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError, FileError, in_words
from calibgraph.files import require_file
from calibgraph.io.bags import MESSAGE_SUFFIX, load_bag_cloud
from calibgraph.io.bags.messages import read_message
from calibgraph.io.bin_columns import read_bin
from calibgraph.io.feather import read_feather
from calibgraph.io.motion import ScanMotion
from calibgraph.io.pcd import read_pcd
from calibgraph.io.ply import read_ply
from calibgraph.io.point_fields import RawCloud, make_cloud, raw_cloud
from calibgraph.model.correspondences import MAX_COORDINATE

MAX_CLOUD_BYTES = 2 * 2**30
MOST_POINTS = 400_000
"""Of a cloud that is used: larger ones, which join many scans, take minutes and gigabytes more and
are no more accurate."""

_PARSER = threading.Lock()
"""numpy reads headers by Python's parser, which in 3.11 raises SystemError if another thread parses
in the midst of it."""

_UNREADABLE = (
    ValueError, TypeError, OSError, EOFError, MemoryError, OverflowError, RecursionError,
    SyntaxError, tokenize.TokenError, zipfile.BadZipFile,
)  # fmt: skip
"""Of numpy, which takes the header of a file as Python, and memory for all that it claims."""

_XYZ, _XYZI = 3, 4
_MOST_COLUMNS = 64


def load_cloud(
    path: Path | str, motion: ScanMotion | None = None, columns: Sequence[str] | None = None
) -> NDArray[np.float32]:
    """Read a cloud.

    Args:
        path: a .npy array (n, 3), (n, 4+) or with named fields, rows of numbers in a .bin (KITTI,
            nuScenes), .pcd, .ply, or a .feather of Argoverse 2; or the address of a message in a
            bag.
        motion: for which points of a bag's message are corrected; None for none.
        columns: names of those of a .bin; told by its content if None.

    Returns:
        (n, 4) x y z [m] in the LiDAR frame and the intensity as the file has it, NaN where it has
        none. Rows whose x, y and z are all NaN or all zero ("no return") are left out.

    Raises:
        FileError: if the file is missing, truncated, empty, of another format, or has values that
            are not finite.
    """
    path = Path(path)
    if path.suffix == MESSAGE_SUFFIX:
        return with_intensity(load_bag_cloud(path, motion))
    return with_intensity(check_points(read_cloud(path, columns).points, path))


def thin_cloud(cloud: NDArray[np.float32]) -> NDArray[np.float32]:
    """At most ``MOST_POINTS`` of a cloud's points, drawn at random, the same each time."""
    if len(cloud) <= MOST_POINTS:
        return cloud
    drawn = np.random.default_rng(0).choice(len(cloud), MOST_POINTS, replace=False)
    return cloud[np.sort(drawn)]


def describe_thinned(sizes: Iterable[int]) -> list[str]:
    """A line if clouds of these sizes have been thinned."""
    full = [size >= MOST_POINTS for size in sizes]
    if not any(full):
        return []
    return [
        f"{sum(full)} of {len(full)} clouds have {MOST_POINTS:,} points or more: "
        f"{MOST_POINTS:,} of each, drawn at random, are used"
    ]


def read_cloud(path: Path, columns: Sequence[str] | None = None) -> RawCloud:
    """All points of a file, and the names of its fields."""
    if require_file(path).stat().st_size > MAX_CLOUD_BYTES:
        raise FileError(path, f"{path.stat().st_size} bytes is too large for one cloud")
    if path.suffix.lower() not in _READERS:
        raise FileError(path, f"unknown cloud format; known are {', '.join(CLOUD_SUFFIXES)}")
    if path.suffix.lower() == ".bin":
        return read_bin(path, columns)
    return _READERS[path.suffix.lower()](path)


def check_points(cloud: NDArray[np.float32], path: Path | str) -> NDArray[np.float32]:
    """The rows of a cloud (n, 4) with a return."""
    xyz, (x, y, z) = cloud[:, :3], cloud[:, :3].T
    measured = ~(np.isnan(x) & np.isnan(y) & np.isnan(z))
    if not measured.any():
        raise FileError(path, "holds no point")
    returned = measured & ((x != 0) | (y != 0) | (z != 0))
    if not returned.any():
        raise FileError(path, f"all of its {measured.sum()} points lie at the origin")
    finite = np.isfinite(xyz)
    if not finite[returned].all():
        row = int(np.flatnonzero(returned & ~finite.all(axis=1))[0])
        raise FileError(
            path,
            f"point {row} is not finite: {xyz[row].tolist()}; record again, or mark points "
            "without a return by NaN in x, y and z",
        )
    with np.errstate(invalid="ignore"):  # random bytes are numbers that warn
        largest = np.abs(xyz).max(where=finite, initial=0.0)
    if largest > MAX_COORDINATE:
        raise FileError(
            path,
            f"holds a coordinate of {largest:.3g}, expected metres, up to {MAX_COORDINATE:g}; "
            "convert its unit, or mark points without a return by NaN in x, y and z",
        )
    return cloud if returned.all() else cloud[returned]


_MOST_MISSING, _MOST_RATIO = 0.1, 1e12


def intensity_fault(cloud: NDArray[np.float32]) -> str:
    """Why the intensities of a cloud (n, 4) are none, as if of another field; empty if they are."""
    values = np.abs(cloud[:, 3])
    finite = values[np.isfinite(values)]
    missing = 1 - len(finite) / max(1, len(values))
    if missing == 1:
        return ""
    if missing > _MOST_MISSING:
        return f"is no finite number at {100 * missing:.0f} % of the points"
    positive = finite[finite > 0]
    if len(positive) and positive.max() > _MOST_RATIO * positive.min(initial=np.inf):
        low, high = np.quantile(positive, (0.02, 0.98))
        if high > _MOST_RATIO * low:
            return f"spans {low:.0e} to {high:.0e}"
    return ""


def with_intensity(cloud: NDArray[np.float32]) -> NDArray[np.float32]:
    """The cloud, NaN in place of intensities that are none."""
    if intensity_fault(cloud):
        cloud = cloud.copy()
        cloud[:, 3] = np.nan
    return cloud


def _read_npy(path: Path) -> RawCloud:
    return cloud_of_array(read_npy(path), path)


def read_npy(path: Path) -> NDArray[Any]:
    """The array in a .npy file.

    Raises:
        FileError: if it is damaged, or holds something else.
    """
    try:
        with _PARSER, path.open("rb") as file, warnings.catch_warnings(action="ignore"):
            array = np.load(file, allow_pickle=False)  # warns of headers by Python 2
            rest = file.read(1)
    except _UNREADABLE as error:
        raise FileError(
            path, f"cannot be read as a .npy array ({in_words(error)}); is it complete?"
        ) from None
    if not isinstance(array, np.ndarray):
        raise FileError(path, "is an archive of arrays, expected one array; write it with np.save")
    if rest:
        raise FileError(
            path, f"goes on after the {array.shape} numbers of its header; write it again"
        )
    return array


def cloud_of_array(array: NDArray[Any], path: Path | str) -> RawCloud:
    """The cloud in an array, (n, 3) or (n, 4+) or of named fields."""
    if array.dtype.names:
        numbers = [name for name in array.dtype.names if array.dtype[name].kind in "fiu"]
        return raw_cloud(path, numbers, lambda name: array[name].ravel())
    if array.ndim != 2 or array.dtype.kind not in "fiu":  # noqa: PLR2004
        raise FileError(
            path, f"has shape {array.shape} of {array.dtype}, expected (n, 3) or (n, 4) numbers"
        )
    rows, columns = array.shape
    if columns < _XYZ or columns > _MOST_COLUMNS or columns > max(rows, _XYZI):
        raise FileError(
            path, f"has shape {array.shape}, expected (n, 3) or (n, 4); is it transposed?"
        )
    return RawCloud(make_cloud(*array[:, :_XYZI].T), ("x", "y", "z", "intensity")[:columns])


def _read_sweep(path: Path) -> RawCloud:
    """Of Argoverse 2."""
    return raw_cloud(path, *read_feather(path))


_READERS: dict[str, Callable[[Path], RawCloud]] = {
    ".npy": _read_npy, ".bin": read_bin, ".pcd": read_pcd, ".ply": read_ply,
    ".feather": _read_sweep,
}  # fmt: skip
CLOUD_SUFFIXES = tuple(_READERS)

_COST = "the error bars become about twice as wide without; record it, or name its field intensity"
"""Measured on data/sample: 1.8 to 2.8 times the error bars without it, with half of the matches."""


def read_cloud_notes(path: Path, columns: Sequence[str] | None = None) -> list[str]:
    """Notes about a file, or about a message in a bag; none if it cannot be read."""
    try:
        if path.suffix == MESSAGE_SUFFIX:
            fields = tuple(each.name for each in read_message(path)[1].fields)
            cloud = RawCloud(load_bag_cloud(path), fields)
        else:
            cloud = read_cloud(path, columns)
            cloud = cloud._replace(points=check_points(cloud.points, path))
    except (CalibrationError, OSError):  # which is named where the frame is read
        return []
    return list(describe_cloud(str(path), cloud))


def describe_cloud(where: str, cloud: RawCloud) -> Iterator[str]:
    """Notes about a cloud."""
    if cloud.told:
        yield f"{where}: {cloud.told}"
    intensity = cloud.points[:, 3]
    if fault := intensity_fault(cloud.points):
        yield f"{where}: the intensity {fault}: it is none, and is left out; {_COST}"
    elif np.isnan(intensity).all():
        yield f"{where}: no intensity among its fields {' '.join(cloud.fields)}; {_COST}"
    elif np.nanmin(intensity) == np.nanmax(intensity):
        yield f"{where}: the intensity is {np.nanmax(intensity) + 0:g} at all points; {_COST}"
