"""Clouds of a moving vehicle: brought to one time, and joined to maps of what it passes.

At 5 m/s a scan of 0.1 s is 50 cm long. With the time of each point and the velocity of the base
LiDAR a point is put where it would have been seen at the stamp. The velocity is the base's, so that
points of another LiDAR are moved in the base's axes, by its pose as far as that is known.

What a LiDAR sees behind the vehicle, one ahead has seen before. So the planes of the base at
instants before and after one are joined, in its axes, to a local map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.bag_frames import Trajectory, motion_by_poses, scans_beside
from calibgraph.io.bags import MESSAGE_SUFFIX
from calibgraph.io.frame import Frame, ScanSteps, twist_by_scans
from calibgraph.model.geometry import invert, move_points
from calibgraph.vehicle.lidars import refine_poses
from calibgraph.vehicle.planes import PLANE, View, find_planes, thinned
from calibgraph.vehicle.travel import read_poses
from factors import displace

REACH_M = 25.0
"""Of a local map before and after: between two LiDARs 120 deg wide, one 4 m behind the other, a
wall 10 m aside leaves the one view 16 m before it enters the other."""
_STILL = np.repeat([np.radians(0.5), 0.05], 3)  # per second: 0.05 deg and 5 mm within a scan
_STEP_M = 3.0  # between clouds of a map
_MOST_PLANES = 1500  # of each of them
_FIRST = 2  # number of the gate at which they are fitted


@dataclass(frozen=True, eq=False)
class Instant:
    """What LiDARs recorded at one instant.

    Attributes:
        frame: its number in the drive.
        returns: per LiDAR (n, 3) its cloud as it was recorded, in its own frame, and (n,) the times
            of its points [s] after the instant's stamp; None if they have none.
        twist_per_s: (6,) rotation [rad/s] and translation [m/s] of the base; None where it is not
            known to move.
    """

    frame: int
    returns: Mapping[str, tuple[Array, Array | None]]
    twist_per_s: Array | None

    @property
    def is_usable(self) -> bool:
        """Whether it stands, or points can be moved."""
        return self.twist_per_s is None or all(of is not None for _, of in self.returns.values())

    def at_stamp(self, lidar: str, T_base_lidar: Array | None) -> Array:
        """(n, 3) a cloud at the instant's stamp; as recorded while the pose is unknown."""
        (points, times_s), twist = self.returns[lidar], self.twist_per_s
        if twist is None or times_s is None or T_base_lidar is None:
            return points
        return move_points(
            displace(move_points(points, T_base_lidar), twist, times_s), invert(T_base_lidar)
        )


class Drive:
    """The frames of a recording, and how the base moves.

    That is by a bag's motion where it was asked for, else by poses with times, else, of folders, by
    registration of the base's clouds, if their stamps are near each other. Without stamps, where
    poses leave a gap and where clouds do not fit the motion is unknown.
    """

    def __init__(self, frames: Sequence[Frame], poses: Path | None) -> None:
        self.frames, self._trajectory, self._steps = frames, _trajectory(poses), ScanSteps()
        of_bag = any(frame.cloud_path.suffix == MESSAGE_SUFFIX for frame in frames)
        self._registers = not of_bag or all(frame.find_motion is not None for frame in frames)

    def instant(self, number: int, lidars: Sequence[str]) -> Instant:
        """The clouds of a frame, and how the base moved."""
        frame, twist = self.frames[number], self.twist(number)
        moves = not frame.is_instant and bool((np.abs(twist) > _STILL).any())
        returns = {name: frame.load_recorded(name, timed=moves) for name in lidars}
        return Instant(number, returns, twist if moves else None)

    def of(self, lidar: str) -> Drive:
        """The drive of another LiDAR, whose motion is by its own clouds."""
        frames = [replace(f, cloud_path=f.lidar_paths[lidar], columns=None) for f in self.frames]
        return Drive(frames, None)

    def local_map(self, number: int, base: str) -> tuple[View, int] | None:
        """What the base sees at a frame, before and after, in its axes there; the last frame of it.

        None where the motion is unknown, or the drive begins or ends within the reach.
        """
        T_map_base = self._around(number)
        seen, views = View(np.empty((0, 3)), np.empty(0, PLANE)), 0
        drift = {True: np.eye(4), False: np.eye(4)}
        for other, T_odometry in sorted(T_map_base.items(), key=lambda of: abs(of[0] - number)):
            instant = self.instant(other, [base])
            if not instant.is_usable:
                continue
            cloud = instant.at_stamp(base, np.eye(4))
            own = View(cloud, thinned(find_planes(cloud), _MOST_PLANES))
            T = drift[other > number] @ T_odometry  # as that of the one beside it
            if views:
                planes, both = [[seen.planes], [own.planes]], np.array([np.eye(4), T])
                try:
                    (_, T), sums = refine_poses(planes, both, (base, base), first=_FIRST)
                except CalibrationError:  # too few planes
                    continue
                if sums.of_poses.basis().shape[1] < len(_STILL):  # a direction is open
                    continue
                drift[other > number] = T @ invert(T_odometry)
            seen, views = seen.joined(own, T), views + 1
        return (seen, max(T_map_base)) if views > 1 else None

    def _around(self, number: int) -> dict[int, Array]:
        """(4, 4) T_number_frame of frames some metres apart; empty if they end before the reach."""
        found = {number: np.eye(4)}
        for side in (-1, 1):
            other, T, last = number, np.eye(4), np.eye(4)
            while np.linalg.norm(T[:3, 3]) < REACH_M:
                other += side
                step = self._step(other - side, other)
                if step is None:
                    return {}
                T = T @ step
                if np.linalg.norm(T[:3, 3] - last[:3, 3]) > _STEP_M:
                    found[other] = last = T
        return found

    def _step(self, one: int, other: int) -> Array | None:
        """(4, 4) T_one_other of the base between neighbouring frames; None if it is unknown."""
        if not 0 <= other < len(self.frames):
            return None
        both = self.frames[one], self.frames[other]
        with suppress(DatasetError):  # no pose near the stamp, or scans do not fit
            poses = [self._pose(frame) for frame in both]
            if poses[0] is not None and poses[1] is not None:
                return np.asarray(invert(poses[0]) @ poses[1])
            if self._registers and scans_beside(both, 0):
                return self._steps.between(*both)
        return None

    def _pose(self, frame: Frame) -> Array | None:
        """(4, 4) T_world_base, if poses are given."""
        if self._trajectory is None or frame.find_motion is not None or frame.stamp_ns is None:
            return frame.T_world_lidar
        return self._trajectory.at((frame.stamp_ns - self._trajectory.start_ns) / 1e9)

    def twist(self, number: int) -> Array:
        """(6,) of the base, zero where nothing is known of it."""
        frame = self.frames[number]
        if (motion := frame.motion) is not None:
            return np.array(motion.twist_per_s)
        with suppress(DatasetError):
            if self._trajectory is not None and frame.stamp_ns is not None:
                return np.array(motion_by_poses(self._trajectory, frame, 0.0).twist_per_s)
            if self._registers and (beside := scans_beside(self.frames, number)):
                return twist_by_scans(frame, beside, self._steps)
        return np.zeros(6)


def _trajectory(poses: Path | None) -> Trajectory | None:
    if poses is None:
        return None
    T_world_lidar, times_s = read_poses(poses)
    if times_s is None:
        return None
    stamps_ns = [round(seconds * 1e9) for seconds in times_s.tolist()]
    return Trajectory.of(poses, zip(stamps_ns, T_world_lidar, strict=True))
