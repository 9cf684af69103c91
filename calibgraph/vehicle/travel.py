"""The direction in which a vehicle travels, in the axes of its LiDAR, from poses of a drive.

A vehicle whose rear axle does not slip moves along its own x axis while it drives straight: in the
axes of the LiDAR that direction has a yaw and a pitch. Stretches in which it hardly turns are
averaged over parts of the drive, which are the independent units: what is left of slopes, wind and
the odometry's errors is alike within a part.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import read_text
from calibgraph.io.rig_parts import pose_of_quaternion
from calibgraph.model.rig import rigid_transform

POSE_FILES = ("poses.csv", "poses.txt", "poses.tum")
"""Of a dataset folder, the first that is there: T_world_lidar of the base LiDAR."""

_STRETCH_M = 5.0  # of one stretch: a millimetre of odometry is 0.01 deg
_MOST_TURN = np.radians(0.5)  # within a stretch, in which a lever arm of 2 m goes 2 cm sideways
_PARTS, _LEAST_PARTS = 8, 4
_MATRIX, _TIME_MATRIX, _TUM = 12, 13, 8  # numbers of a line


@dataclass(frozen=True)
class Travel:
    """The direction of travel in the axes of the LiDAR.

    Attributes:
        yaw_rad: from the x axis to the left.
        pitch_rad: from the x axis down.
        yaw_sigma_rad: standard deviation; infinite if the drive cannot tell.
        pitch_sigma_rad: likewise.
        straight_m: length of the straight stretches.
    """

    yaw_rad: float
    pitch_rad: float
    yaw_sigma_rad: float
    pitch_sigma_rad: float
    straight_m: float


def read_poses(path: Path | str) -> tuple[Array, Array | None]:
    """(n, 4, 4) T_world_lidar of a text file, in order of time, and (n,) their times [s], if any.

    A line has 12 numbers of the upper rows of the matrix (KITTI), the same after a time, or time
    x y z qx qy qz qw (TUM), with blanks or commas between them; lines after a # are skipped.

    Raises:
        FileError: if a line is none of these or unlike the first, or there are fewer than two.
    """
    path = Path(path)
    lines = [line.strip() for line in read_text(path).splitlines()]
    rows = [
        (number, line.replace(",", " ").split())
        for number, line in enumerate(lines, 1)
        if line and not line.startswith("#")
    ]
    if len(rows) < 2:  # noqa: PLR2004
        raise FileError(path, f"holds {len(rows)} poses, at least 2 are needed")
    for number, words in rows:
        if len(words) != len(rows[0][1]):
            raise FileError(path, f"line {number} has {len(words)} numbers, the first has others")
    poses, times = zip(*(_pose(words, path, number) for number, words in rows), strict=True)
    return np.array(poses), None if times[0] is None else np.array(times)


def _pose(words: list[str], path: Path, number: int) -> tuple[Array, float | None]:
    try:
        values = np.array(words, dtype=np.float64)
        time_s = None if len(values) == _MATRIX else float(values[0])
        if len(values) == _TUM:
            return pose_of_quaternion(values[1:4].tolist(), values[4:].tolist()), time_s
        if len(values) in (_MATRIX, _TIME_MATRIX):
            T = rigid_transform([*values[-_MATRIX:].reshape(3, 4).tolist(), [0, 0, 0, 1]])
            return T, time_s
    except ValueError as error:
        raise FileError(path, f"line {number}: {error}") from error
    raise FileError(
        path, f"line {number} has {len(words)} numbers; expected 12 of a matrix (KITTI), time and "
        "these 12, or time x y z qx qy qz qw (TUM)"
    )  # fmt: skip


def direction_of_travel(T_world_lidar: Array) -> Travel:
    """The mean direction of travel over the straight stretches of (n, 4, 4) poses."""
    found = np.array([*_stretches(T_world_lidar)]).reshape(-1, 2)
    straight_m = _STRETCH_M * len(found)
    if len(found) < 2 * _LEAST_PARTS:
        return Travel(0.0, 0.0, np.inf, np.inf, straight_m)
    parts = np.array_split(found, min(_PARTS, len(found) // 2))
    means = np.array([part.mean(axis=0) for part in parts])
    middle = np.median(found, axis=0)
    sigmas = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    yaw, pitch, yaw_sigma, pitch_sigma = map(float, (*middle, *sigmas))
    return Travel(yaw, pitch, yaw_sigma, pitch_sigma, straight_m)


def _stretches(T_world_lidar: Array) -> Iterator[tuple[float, float]]:
    """Yaw and pitch [rad] of the straight stretches, one behind the other."""
    positions, rotations = T_world_lidar[:, :3, 3], T_world_lidar[:, :3, :3]
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum()])
    first = 0
    while True:
        last = int(np.searchsorted(along, along[first] + _STRETCH_M))
        if last >= len(along):
            return
        if _turn(rotations[first : last + 1]) > _MOST_TURN:
            first += max(1, (last - first) // 4)
            continue
        ahead = positions[last] - positions[first]
        x, y, z = (ahead @ rotations[first : last + 1]).mean(axis=0)  # in the LiDAR's axes
        if np.hypot(x, y) > abs(z) and x > 0:  # not backwards
            yield float(np.arctan2(y, x)), float(np.arctan2(-z, np.hypot(x, y)))
        first = last


def _turn(rotations: NDArray[np.float64]) -> float:
    """The largest angle [rad] of rotations against their first."""
    traces = np.einsum("ij,nij->n", rotations[0], rotations)
    return float(np.arccos(np.clip((traces.min() - 1.0) / 2.0, -1.0, 1.0)))
