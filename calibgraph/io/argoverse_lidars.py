"""The two LiDARs of an Argoverse 2 log, whose sweeps join both in the frame of the vehicle.

Lasers 0 to 31 are of one and 32 to 63 of the other. Which half is ``up_lidar`` is not documented,
so the log's first sweep decides: only in the frame of its own LiDAR a laser has one elevation.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.io.rig_parts import IncompleteCamera, pose_of_quaternion
from calibgraph.io.tables import read_feather
from calibgraph.model.geometry import invert, move_points

VEHICLE, UP_AND_DOWN = "egovehicle", ("up_lidar", "down_lidar")
SWEEPS, POSES = Path("sensors/lidar"), Path("calibration/egovehicle_SE3_sensor.feather")
SUFFIXES = tuple(f".{name}" for name in UP_AND_DOWN)
_QUATERNION, _PLACE = ("qx", "qy", "qz", "qw"), ("tx_m", "ty_m", "tz_m")
_HALF = 32
_LEVEL = 0.1  # share of the lasers
_CLEARLY = 1.1  # times the scatter: simulated logs have 25 standing, 2 at 10 m/s, 1.25 at 20 m/s


def file_of(cloud: Path) -> Path:
    """The sweep STAMP.feather of STAMP.up_lidar and STAMP.down_lidar; other files as they are."""
    return cloud.with_suffix(".feather") if cloud.suffix in SUFFIXES else cloud


def read_lidar(cloud: Path) -> tuple[list[str], Callable[[str], NDArray[Any]]]:
    """The points of one LiDAR in its own frame, as of a Feather file.

    Their times are 0: sweeps are corrected for motion, to their stamp.
    """
    log, column = cloud.parents[2], read_feather(file_of(cloud))[1]
    own = (column("laser_number") < _HALF) == (cloud.suffix[1:] == _lower_half(log))
    found = move_points(_points(column)[own], invert(T_egovehicle_sensor(log, cloud.suffix[1:])))
    values = dict(zip("xyz", found.T, strict=True))
    values |= {"intensity": column("intensity")[own], "t": np.zeros(len(found))}
    return [*values], values.__getitem__


def T_egovehicle_sensor(log: Path, name: str) -> Array:
    """(4, 4) as the log states it; of the vehicle itself the identity."""
    if name == VEHICLE:
        return np.eye(4)
    pose = row(log / POSES, name, (*_QUATERNION, *_PLACE))
    xyz_m, xyzw = ([pose[key] for key in keys] for keys in (_PLACE, _QUATERNION))
    try:
        return pose_of_quaternion(xyz_m, xyzw)
    except ValueError as error:
        raise FileError(log / POSES, str(error)) from error


def row(path: Path, name: str, columns: Sequence[str]) -> dict[str, Any]:
    """The columns of a table, at the sensor with a name."""
    column = read_feather(path)[1]
    names, table = [*map(str, column("sensor_name"))], {key: column(key) for key in columns}
    if name not in names:
        found = ", ".join(names) or "none"
        raise IncompleteCamera(path, f"has no row of {name!r}; found {found}")
    return {key: values[names.index(name)].item() for key, values in table.items()}


def _points(column: Callable[[str], NDArray[Any]]) -> Array:
    return np.column_stack([column(axis) for axis in "xyz"]).astype(np.float64)


@lru_cache
def _lower_half(log: Path) -> str:
    """The LiDAR of lasers 0 to 31."""
    sweep, scatters = min((log / SWEEPS).glob("*.feather")), {}
    column = read_feather(sweep)[1]
    points, lasers = _points(column), column("laser_number").astype(np.int64)
    halves = lasers < _HALF, (lasers >= _HALF) & (lasers < 2 * _HALF)
    if not all(half.any() for half in halves) or not np.logical_or(*halves).all():
        raise FileError(sweep, f"has lasers {lasers.min()} to {lasers.max()}, expected 0 to 63 of "
                        f"two LiDARs; calibrate {log} as one cloud")  # fmt: skip
    for names in (UP_AND_DOWN, UP_AND_DOWN[::-1]):
        own = [invert(T_egovehicle_sensor(log, name)) for name in names]
        parts = [move_points(points[half], T) for half, T in zip(halves, own, strict=True)]
        each = [_scatter_deg(of, lasers[half]) for half, of in zip(halves, parts, strict=True)]
        scatters[names[0]] = sum(each)
    name = min(scatters, key=scatters.__getitem__)
    if max(scatters.values()) < _CLEARLY * scatters[name]:
        raise FileError(sweep, "its lasers do not tell its two LiDARs apart: elevations of one "
                        f"scatter alike by both orders; calibrate {log} as one cloud")  # fmt: skip
    return name


def _scatter_deg(points: Array, lasers: NDArray[np.int64]) -> float:
    """Standard deviation of elevations of the lasers that scatter least, which are level.

    Sweeps are corrected for motion, which scatters the elevations of the others.
    """
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    _, of, counts = np.unique(lasers, return_inverse=True, return_counts=True)
    apart = elevation - (np.bincount(of, elevation) / counts)[of]
    return float(np.quantile(np.sqrt(np.bincount(of, apart**2) / counts), _LEVEL))
