"""Logs of the Argoverse 2 sensor data set: Feather tables, sweeps and images named by stamps.

Its clouds are of two LiDARs, in the frame of the vehicle (egovehicle), corrected for motion;
``LOG/up_lidar`` names the log with each LiDAR in its own frame. Its images are undistorted.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.errors import DatasetError, FileError
from calibgraph.files import checked_model
from calibgraph.io.argoverse_lidars import (
    POSES,
    SWEEPS,
    UP_AND_DOWN,
    VEHICLE,
    T_egovehicle_sensor,
    row,
)
from calibgraph.io.frame import Frame
from calibgraph.io.frame_files import files_by_stem
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.published import PublishedFolder
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera

_CAMERAS, _LENSES = Path("sensors/cameras"), Path("calibration/intrinsics.feather")
_LENS = ("fx_px", "fy_px", "cx_px", "cy_px")
_SIZE = ("width_px", "height_px")
_MOST_DIGITS = 18  # of a stamp, in 64 bits
_APART_NS = 30_000_000
"""Between a sweep and its image: half the period of the cameras around the vehicle, and some."""


def argoverse(path: Path) -> PublishedFolder | None:
    """A log, whose clouds are of both LiDARs; or one of these in it, which is the base of both.

    None if a path is neither.
    """
    log, base = (path.parent, path.name) if path.name in UP_AND_DOWN else (path, VEHICLE)
    if not ((log / POSES).is_file() and (log / SWEEPS).is_dir()):
        return None

    def cameras() -> Sequence[str]:
        return sorted(each.name for each in (log / _CAMERAS).glob("*/"))

    return PublishedFolder(
        lambda: _lidars(log, base),
        cameras,
        lambda name: _camera(log, base, name),
        lambda names: _frames(log, base, names),
    )


def _lidars(log: Path, base: str) -> Mapping[str, Any]:
    """What a rig has of LiDARs."""
    T_base_egovehicle = invert(T_egovehicle_sensor(log, base))
    lidars: dict[str, Any] = {base: {}} | {
        name: {"T_base_lidar": T_base_egovehicle @ T_egovehicle_sensor(log, name)}
        for name in _beside(base)
    }
    return {"lidar": base, "lidars": lidars if len(lidars) > 1 else None}


def _beside(base: str) -> list[str]:
    """The other LiDARs."""
    return [name for name in UP_AND_DOWN if base not in (VEHICLE, name)]


def _camera(log: Path, base: str, name: str) -> Camera:
    T_egovehicle_camera = T_egovehicle_sensor(log, name)
    lens = row(log / _LENSES, name, (*_LENS, *_SIZE))
    content = {
        **{column: lens[column] for column in _SIZE},
        "intrinsics_px": {column[:2]: lens[column] for column in _LENS},
        "T_camera_lidar": invert(T_egovehicle_camera) @ T_egovehicle_sensor(log, base),
    }
    return checked_model(Camera, content, f"{log / _LENSES}: {name}")


def _frames(log: Path, base: str, cameras: Sequence[str]) -> list[Frame]:
    """The sweeps that have an image of every camera, in order of time."""
    sweeps = _stamped(log / SWEEPS, (".feather",))
    stamps = np.array(list(sweeps))
    images = {name: _stamped(log / _CAMERAS / name, IMAGE_SUFFIXES) for name in cameras}
    nearest = {}
    for name, found in images.items():
        others = np.array(list(found))
        nearest[name] = others[np.abs(np.subtract.outer(stamps, others)).argmin(axis=1)]
    frames = [
        Frame(
            i,
            str(stamp),
            cloud if base == VEHICLE else cloud.with_suffix(f".{base}"),
            {n: images[n][int(nearest[n][i])] for n in cameras},
            lidar_paths={n: cloud.with_suffix(f".{n}") for n in _beside(base)},
        )
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
