"""Logs of the Argoverse 2 sensor data set: Feather tables, sweeps and images named by stamps.

Its clouds are of two LiDARs, in the frame of the vehicle (egovehicle), corrected for motion; its
images are undistorted.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.errors import DatasetError, FileError
from calibgraph.files import checked_model
from calibgraph.io.frame import Frame
from calibgraph.io.frame_files import files_by_stem
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.published import IncompleteCamera, PublishedFolder
from calibgraph.io.rig_parts import pose_of_quaternion
from calibgraph.io.tables import read_feather
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera

_LIDAR, _CAMERAS = Path("sensors/lidar"), Path("sensors/cameras")
_POSES, _LENSES = (
    Path("calibration/egovehicle_SE3_sensor.feather"), Path("calibration/intrinsics.feather"),
)  # fmt: skip
_QUATERNION, _PLACE = ("qx", "qy", "qz", "qw"), ("tx_m", "ty_m", "tz_m")
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px")
_SIZE = ("width_px", "height_px")
_MOST_DIGITS = 18  # of a stamp, in 64 bits
_APART_NS = 30_000_000
"""Between a sweep and its image: half the period of the cameras around the vehicle, and some."""


def argoverse(log: Path) -> PublishedFolder | None:
    """A log; None if a folder is none."""
    if not ((log / _POSES).is_file() and (log / _LIDAR).is_dir()):
        return None

    def cameras() -> Sequence[str]:
        return sorted(each.name for each in (log / _CAMERAS).glob("*/"))

    return PublishedFolder(
        "egovehicle", cameras, lambda name: _camera(log, name), lambda names: _frames(log, names)
    )


def _camera(log: Path, name: str) -> Camera:
    pose = _row(log / _POSES, name, (*_QUATERNION, *_PLACE))
    lens = _row(log / _LENSES, name, (*_LENS, *_SIZE))
    xyz_m, xyzw = ([pose[key] for key in keys] for keys in (_PLACE, _QUATERNION))
    try:
        T_egovehicle_camera = pose_of_quaternion(xyz_m, xyzw)
    except ValueError as error:
        raise FileError(log / _POSES, str(error)) from error
    content = {
        **{column: lens[column] for column in _SIZE},
        "intrinsics_px": {column[:2]: lens[column] for column in _LENS},
        "T_camera_lidar": invert(T_egovehicle_camera),
    }
    return checked_model(Camera, content, f"{log / _LENSES}: {name}")


def _row(path: Path, name: str, columns: Sequence[str]) -> dict[str, Any]:
    column = read_feather(path)[1]
    names, table = [*map(str, column("sensor_name"))], {key: column(key) for key in columns}
    if name not in names:
        found = ", ".join(names) or "none"
        raise IncompleteCamera(path, f"has no row of {name!r}; found {found}")
    return {key: values[names.index(name)].item() for key, values in table.items()}


def _frames(log: Path, cameras: Sequence[str]) -> list[Frame]:
    """The sweeps that have an image of every camera, in order of time."""
    sweeps = _stamped(log / _LIDAR, (".feather",))
    stamps = np.array(list(sweeps))
    images = {name: _stamped(log / _CAMERAS / name, IMAGE_SUFFIXES) for name in cameras}
    nearest = {}
    for name, found in images.items():
        others = np.array(list(found))
        nearest[name] = others[np.abs(np.subtract.outer(stamps, others)).argmin(axis=1)]
    frames = [
        Frame(i, str(stamp), cloud, {n: images[n][int(nearest[n][i])] for n in cameras})
        for i, (stamp, cloud) in enumerate(sweeps.items())
        if all(abs(nearest[n][i] - stamp) <= _APART_NS for n in cameras)
    ]
    if not frames:
        raise DatasetError(
            f"{log}: no sweep has an image of every camera ({', '.join(cameras)}) within "
            f"{_APART_NS // 10**6} ms; choose other cameras by --rig"
        )
    return frames


def _stamped(folder: Path, suffixes: Sequence[str]) -> dict[int, Path]:
    """Files by their stamp [ns], in order of time."""
    found = files_by_stem(folder, suffixes)
    for stem, path in found.items():
        if not stem.isdecimal() or len(stem) > _MOST_DIGITS:
            raise FileError(path, "its name is no stamp in nanoseconds")
    return {int(stem): found[stem] for stem in sorted(found, key=int)}
