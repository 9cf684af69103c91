"""Logs of the Argoverse 2 sensor data set: Feather tables, sweeps and images named by stamps.

Its clouds are of two LiDARs, in the frame of the vehicle (egovehicle), corrected for motion.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.files import checked_model
from calibgraph.io.feather import read_feather
from calibgraph.io.frame_files import (
    FrameFiles,
    IncompleteCamera,
    RigRead,
    files_by_stem,
    rig_of_complete,
)
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.rotations import pose_of_quaternion
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera

VEHICLE = "egovehicle"
_LIDAR, _CAMERAS = Path("sensors/lidar"), Path("sensors/cameras")
_POSES, _LENSES = (
    Path("calibration/egovehicle_SE3_sensor.feather"), Path("calibration/intrinsics.feather"),
)  # fmt: skip
_TRAJECTORY = Path("city_SE3_egovehicle.feather")
_QUATERNION, _PLACE = ("qx", "qy", "qz", "qw"), ("tx_m", "ty_m", "tz_m")
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px")
_SIZE = ("width_px", "height_px")
_MOST_DIGITS = 18  # of a stamp, in 64 bits
_APART_NS = 30_000_000
"""Between a sweep and its image: half the period of the cameras around the vehicle, and some."""


def is_argoverse(folder: Path) -> bool:
    """Whether a folder is a log."""
    return (folder / _POSES).is_file() and (folder / _LIDAR).is_dir()


def read_argoverse_rig(log: Path) -> RigRead:
    """The rig of a log: T_camera_lidar of the vehicle's frame; its images are undistorted."""
    poses = _by_name(log / _POSES, (*_QUATERNION, *_PLACE))
    lenses = _by_name(log / _LENSES, (*_LENS, *_SIZE))
    names = sorted(each.name for each in (log / _CAMERAS).glob("*/"))
    return rig_of_complete(VEHICLE, names, lambda name: _camera(log, name, lenses, poses), log)


def _camera(
    log: Path, name: str, lenses: dict[str, dict[str, Any]], poses: dict[str, dict[str, Any]]
) -> Camera:
    for path, table in ((_LENSES, lenses), (_POSES, poses)):
        if name not in table:
            found = ", ".join(table) or "none"
            raise IncompleteCamera(log / path, f"has no row of {name!r}; found {found}")
    lens = lenses[name]
    content = {
        **{column: lens[column] for column in _SIZE},
        "intrinsics_px": {column[:2]: lens[column] for column in _LENS},
        "T_camera_lidar": invert(_matrix(poses[name], log / _POSES)),
    }
    return checked_model(Camera, content, f"{log / _LENSES}: {name}")


def argoverse_frames(log: Path, cameras: Sequence[str]) -> list[FrameFiles]:
    """The sweeps that have an image of every camera, in order of time."""
    sweeps = _stamped(log / _LIDAR, (".feather",))
    stamps = np.array(list(sweeps))
    images = {name: _stamped(log / _CAMERAS / name, IMAGE_SUFFIXES) for name in cameras}
    nearest = {name: _nearest(stamps, np.array(list(found))) for name, found in images.items()}
    frames = [
        FrameFiles(str(stamp), cloud, {n: images[n][int(nearest[n][i])] for n in cameras})
        for i, (stamp, cloud) in enumerate(sweeps.items())
        if all(abs(nearest[n][i] - stamp) <= _APART_NS for n in cameras)
    ]
    if not frames:
        raise DatasetError(
            f"{log}: no sweep has an image of every camera ({', '.join(cameras)}) within "
            f"{_APART_NS // 10**6} ms; choose other cameras by --rig"
        )
    return frames


def describe_motion(log: Path) -> str:
    """How far the vehicle moves between sweeps and their images, in a line; empty without poses."""
    if not (log / _TRAJECTORY).is_file():
        return ""
    cameras = [each.name for each in (log / _CAMERAS).glob("*/")]
    frames = argoverse_frames(log, cameras)
    sweeps = np.array([int(frame.stem) for frame in frames])
    images = np.array([[int(path.stem) for path in frame.images.values()] for frame in frames])
    table = read_feather(log / _TRAJECTORY, ("timestamp_ns", *_PLACE))
    start, order = int(sweeps[0]), np.argsort(table["timestamp_ns"])
    times_s = (table["timestamp_ns"][order].astype(np.int64) - start) * 1e-9
    places_m = np.column_stack([table[axis][order] for axis in _PLACE]).astype(np.float64)

    def place(stamps: NDArray[Any]) -> Array:
        at_s = (stamps - start) * 1e-9
        return np.stack([np.interp(at_s, times_s, axis) for axis in places_m.T], axis=-1)

    moved_m = np.linalg.norm(place(images) - place(sweeps)[:, None], axis=2).max(axis=1)
    return (
        f"{log}: {len(frames)} sweeps have an image of all {len(cameras)} cameras; the vehicle "
        f"moves {np.median(moved_m):.2f} m (median), at most {moved_m.max():.2f} m, between a "
        "sweep and its images"
    )


def _stamped(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Files by their stamp [ns], in order of time."""
    found = files_by_stem(folder, suffixes)
    for stem, path in found.items():
        if not stem.isdecimal() or len(stem) > _MOST_DIGITS:
            raise FileError(path, "its name is no stamp in nanoseconds")
    return {int(stem): found[stem] for stem in sorted(found, key=int)}


def _nearest(stamps: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.int64]:
    """Of each stamp, the nearest of the others, which are in order."""
    after = np.searchsorted(others, stamps).clip(1, max(1, len(others) - 1))
    before = others[after - 1]
    after_ns = others[np.minimum(after, len(others) - 1)]
    return np.asarray(np.where(stamps - before <= after_ns - stamps, before, after_ns))


def _matrix(row: dict[str, Any], path: Path) -> Array:
    """(4, 4) T_egovehicle_sensor of a row."""
    xyz_m, xyzw = ([row[name] for name in names] for names in (_PLACE, _QUATERNION))
    try:
        return pose_of_quaternion(xyz_m, xyzw)
    except ValueError as error:
        raise FileError(path, str(error)) from error


def _by_name(path: Path, columns: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The rows of a table of sensors, by their names."""
    table = read_feather(path, ("sensor_name", *columns))
    rows = zip(*(table[column].tolist() for column in columns), strict=True)
    names = map(str, table["sensor_name"])
    return {
        name: dict(zip(columns, row, strict=True)) for name, row in zip(names, rows, strict=True)
    }
