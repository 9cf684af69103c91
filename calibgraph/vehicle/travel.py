"""The direction in which a vehicle travels, in the axes of its LiDAR, from poses of a drive.

A vehicle whose rear axle does not slip moves along its own x axis while it drives straight: in the
axes of the LiDAR that direction has a yaw and a pitch. Stretches in which it hardly turns are
averaged over parts of the drive, which are the independent units: what is left of slopes, wind and
the odometry's errors is alike within a part.

In a bend the rear axle still moves along x, and a LiDAR that is ahead of it by l moves to the side
by l times the turn. How far it is to the side only changes its speed, which poses cannot tell.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

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
_SLIP_M = 0.08  # rear tyres slip by some 0.15 deg for each m/s^2: at 5.5 m/s, like so much lever
_LEAST_TURN = np.radians(20.0)  # of a part of the drive, so that it counts
_MATRIX, _TIME_MATRIX, _TUM = 12, 13, 8  # numbers of a line


@dataclass(frozen=True)
class Travel:
    """The direction of travel in the axes of the LiDAR; by default, nothing is known of it.

    Attributes:
        yaw_rad: from the x axis to the left.
        pitch_rad: from the x axis down.
        yaw_sigma_rad: standard deviation; infinite if the drive cannot tell.
        pitch_sigma_rad: likewise.
        ahead_m: how far the LiDAR is ahead of the rear axle.
        ahead_sigma_m: standard deviation; infinite if the drive cannot tell.
    """

    yaw_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_sigma_rad: float = np.inf
    pitch_sigma_rad: float = np.inf
    ahead_m: float = 0.0
    ahead_sigma_m: float = np.inf

    @property
    def direction(self) -> Array:
        """(3,) unit vector."""
        level = np.cos(self.pitch_rad)
        turned = np.cos(self.yaw_rad) * level, np.sin(self.yaw_rad) * level
        return np.array([*turned, -np.sin(self.pitch_rad)])


def read_poses(path: Path | str) -> tuple[Array, Array | None]:
    """(n, 4, 4) T_world_lidar of a text file, in order of time, and (n,) their times [s], if any.

    A line has 12 numbers of the upper rows of the matrix (KITTI), the same after a time, or time
    x y z qx qy qz qw (TUM), with blanks or commas between them; lines after a # are skipped.

    Raises:
        FileError: if a line is none of these or unlike the first, or there are fewer than two.
    """
    path, rows, poses = Path(path), list[list[str]](), list[Array]()
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.replace(",", " ").split()
        if words and not words[0].startswith("#"):
            rows.append(words)
            try:
                poses.append(_pose(words, rows[0]))
            except ValueError as error:
                raise FileError(path, f"line {number}: {error}") from error
    if len(poses) < 2:  # noqa: PLR2004
        raise FileError(path, f"holds {len(poses)} poses, at least 2 are needed")
    has_times = len(rows[0]) != _MATRIX
    return np.array(poses), np.array([row[0] for row in rows], float) if has_times else None


def _pose(words: Sequence[str], first: Sequence[str]) -> Array:
    """(4, 4) of a line that is like the first."""
    if len(words) != len(first):
        raise ValueError(f"{len(words)} numbers, the first line has {len(first)}")
    values = np.array(words, dtype=np.float64)
    if len(values) == _TUM:
        return pose_of_quaternion(values[1:4].tolist(), values[4:].tolist())
    if len(values) in (_MATRIX, _TIME_MATRIX):
        return rigid_transform([*values[-_MATRIX:].reshape(3, 4).tolist(), [0, 0, 0, 1]])
    raise ValueError(
        f"{len(words)} numbers; expected 12 of a matrix (KITTI), time and these 12, or time "
        "x y z qx qy qz qw (TUM)"
    )


def direction_of_travel(T_world_lidar: Array) -> Travel:
    """The mean direction of travel over the straight stretches of (n, 4, 4) poses.

    And how far the LiDAR is ahead of the rear axle, from stretches that turn.
    """
    every = np.array([*_stretches(T_world_lidar)]).reshape(-1, 7)
    chords = every[every[:, 6] <= _MOST_TURN, :3]
    chords = chords[(np.hypot(*chords.T[:2]) > np.abs(chords[:, 2])) & (chords[:, 0] > 0)]
    level = np.hypot(*chords.T[:2])  # not backwards
    found = np.column_stack([
        np.arctan2(chords[:, 1], chords[:, 0]), np.arctan2(-chords[:, 2], level)
    ])  # fmt: skip
    if len(found) < 2 * _LEAST_PARTS:
        return Travel()
    parts = np.array_split(found, min(_PARTS, len(found) // 2))
    means = np.array([part.mean(axis=0) for part in parts])
    middle = np.median(found, axis=0)
    sigmas = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    travel = Travel(*map(float, (*middle, *sigmas)))
    ahead_m, ahead_sigma_m = _lever(every, travel.direction)
    return replace(travel, ahead_m=ahead_m, ahead_sigma_m=ahead_sigma_m)


def _lever(stretches: Array, ahead: Array) -> tuple[float, float]:
    """How far the LiDAR is ahead of the rear axle, and its sigma [m], along (3,) ``ahead``."""
    chords, turns = stretches[:, :3], stretches[:, 3:6]
    axis = np.linalg.eigh(turns.T @ turns)[1][:, 2]  # of all turns
    up = axis * np.sign(axis[2])
    turned, aside = turns @ up, chords @ np.cross(up, ahead)
    parts = np.array_split(np.column_stack([turned * aside, turned**2]), _PARTS)
    sums = np.array([part.sum(axis=0) for part in parts])
    if (sums[:, 1] > _LEAST_TURN**2).sum() < _LEAST_PARTS:
        return 0.0, np.inf
    left = sums.sum(axis=0) - sums  # the jackknife
    without = left[:, 0] / left[:, 1]
    spread = np.sqrt((_PARTS - 1) / _PARTS * ((without - without.mean()) ** 2).sum())
    return float(sums[:, 0].sum() / sums[:, 1].sum()), float(np.hypot(spread, _SLIP_M))


def _stretches(T_world_lidar: Array) -> Iterator[Array]:
    """(7,) the way, the turn from end to end and the largest angle [rad] of each stretch.

    They are in the LiDAR's axes, one behind the other; those that turn overlap.
    """
    positions, rotations = T_world_lidar[:, :3, 3], T_world_lidar[:, :3, :3]
    along = np.concatenate([[0.0], np.linalg.norm(np.diff(positions, axis=0), axis=1).cumsum()])
    first = 0
    while True:
        last = int(np.searchsorted(along, along[first] + _STRETCH_M))
        if last >= len(along):
            return
        way = ((positions[last] - positions[first]) @ rotations[first : last + 1]).mean(axis=0)
        every = Rotation.from_matrix(rotations[first].T @ rotations[first : last + 1])
        largest = every.magnitude().max()
        yield np.array([*way, *every[-1].as_rotvec(), largest])
        first = last if largest <= _MOST_TURN else first + max(1, (last - first) // 4)
