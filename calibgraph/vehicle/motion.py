"""Clouds of a moving vehicle, brought to one time: the stamp of each instant.

At 5 m/s a scan of 0.1 s is 50 cm long. With the time of each point and the velocity of the base
LiDAR a point is put where it would have been seen at the stamp. The velocity is the base's, so that
points of another LiDAR are moved in the base's axes, by its pose as far as that is known.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.io.bag_frames import Trajectory, motion_by_poses
from calibgraph.io.frame import Frame
from calibgraph.model.geometry import invert
from calibgraph.vehicle.travel import read_poses
from factors import displace

_STILL = np.repeat([np.radians(0.5), 0.05], 3)  # per second: 0.05 deg and 5 mm within a scan


@dataclass(frozen=True, eq=False)
class Instant:
    """What LiDARs recorded at one instant.

    Attributes:
        clouds: per LiDAR (n, 3) as it was recorded, in its own frame.
        times_s: per LiDAR (n,) of its points after the instant's stamp; None if they have none.
        twist_per_s: (6,) rotation [rad/s] and translation [m/s] of the base; None where it is not
            known to move.
    """

    clouds: Mapping[str, Array]
    times_s: Mapping[str, Array | None]
    twist_per_s: Array | None

    @property
    def is_usable(self) -> bool:
        """Whether it stands, or points can be moved."""
        return self.twist_per_s is None or all(of is not None for of in self.times_s.values())

    def at_stamp(self, lidar: str, T_base_lidar: Array | None) -> Array:
        """(n, 3) a cloud at the instant's stamp; as recorded while the pose is unknown."""
        points, twist, times_s = self.clouds[lidar], self.twist_per_s, self.times_s[lidar]
        if twist is None or times_s is None or T_base_lidar is None:
            return points
        return _moved(displace(_moved(points, T_base_lidar), twist, times_s), invert(T_base_lidar))


def _moved(points: Array, T: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def read_instants(
    frames: Iterable[Frame], lidars: Sequence[str], poses: Path | None
) -> list[Instant]:
    """The clouds of frames, and how the base moved.

    That is by a bag's motion where it was asked for, else by poses with times, if stamps name the
    frames. Where poses leave a gap, the motion is unknown.
    """
    trajectory = _trajectory(poses)
    found = []
    for frame in frames:
        twist = _twist(frame, trajectory)
        moves = bool((np.abs(twist) > _STILL).any())
        read = {name: frame.load_recorded(name, timed=moves) for name in lidars}
        clouds = {name: cloud for name, (cloud, _) in read.items()}
        times_s = {name: times for name, (_, times) in read.items()}
        found.append(Instant(clouds, times_s, twist if moves else None))
    return found


def _trajectory(poses: Path | None) -> Trajectory | None:
    if poses is None:
        return None
    T_world_lidar, times_s = read_poses(poses)
    if times_s is None:
        return None
    stamps_ns = [round(seconds * 1e9) for seconds in times_s.tolist()]
    return Trajectory.of(poses, zip(stamps_ns, T_world_lidar, strict=True))


def _twist(frame: Frame, trajectory: Trajectory | None) -> Array:
    """(6,) of the base, zero where nothing is known of it."""
    motion = frame.motion
    if motion is None and trajectory is not None and frame.stamp_ns is not None:
        with suppress(DatasetError):  # no pose near the stamp
            motion = motion_by_poses(trajectory, frame, 0.0)
    return np.zeros(6) if motion is None else np.array(motion.twist_per_s)
