"""How the LiDAR of a bag moves, from odometry, from /tf, or by registration of its scans."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.io.bags.messages import Bag, Drive, read_message
from calibgraph.io.bags.options import ODOMETRY, BagOptions
from calibgraph.io.bags.transforms import (
    MOVING,
    Transforms,
    pose_matrix,
    stamp_ns_of,
    stamped_transforms,
    values_of,
)
from calibgraph.io.frame import Frame, seconds_between, twist_by_scans
from calibgraph.io.motion import ScanMotion, twist_between
from calibgraph.model.geometry import transform

MotionOf = Callable[[Frame, float], ScanMotion]
"""Finds the motion of a frame, at a time [s] after its stamp."""

_ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
_HALF_S = 0.05  # half a turn of a LiDAR at 10 Hz: the velocity is the mean of a scan
_GAP_S = 0.5
"""Poses farther apart are not interpolated: at 2 m/s^2 the mean is off by 0.25 m/s, 1 cm a scan."""
_NEIGHBOUR_S = 0.35  # of a scan, that is registered with it


def motion_finder(path: Path, frames: Sequence[Frame], options: BagOptions) -> MotionOf:
    """A function of a frame, as recorded, that returns the motion during its scan.

    Raises:
        FileError, DatasetError: if the bag has no such topic or no such transforms.
    """
    if options.motion == "scans":
        return partial(_by_scans, frames)
    bag = Bag(path)
    lidar = read_message(frames[0].cloud_path)[1].header.frame_id.lstrip("/")
    poses = _odometry if options.motion == "odometry" else _moving_transforms
    return partial(_by_poses, _Trajectory.of(path, poses(bag, lidar, options)))


@dataclass(frozen=True, eq=False)
class _Trajectory:
    """Poses of the LiDAR in a fixed frame: (n,) stamps [s] after the first [ns], and (n, 4, 4)."""

    path: Path
    start_ns: int
    stamps_s: Array
    T_world_lidar: Array

    @staticmethod
    def of(path: Path, poses: Iterator[tuple[int, Array]]) -> _Trajectory:
        """Of stamps [ns] and poses in any order; of several with one stamp, the last."""
        by_stamp = dict(sorted(dict(poses).items()))
        if len(by_stamp) < 2:  # noqa: PLR2004
            raise DatasetError(f"{path}: has {len(by_stamp)} poses of the LiDAR; --motion needs "
                               "those of the drive, or --motion scans")  # fmt: skip
        start_ns = next(iter(by_stamp))
        stamps = np.array([stamp - start_ns for stamp in by_stamp], np.float64) / 1e9
        return _Trajectory(path, start_ns, stamps, np.array(list(by_stamp.values())))

    def at(self, stamp_s: float) -> Array:
        """(4, 4) between the poses before and after.

        Raises:
            DatasetError: if they are farther apart than can be interpolated.
        """
        after = int(np.clip(np.searchsorted(self.stamps_s, stamp_s), 1, len(self.stamps_s) - 1))
        both = self.stamps_s[after - 1 : after + 1]
        if not both[0] - _HALF_S <= stamp_s <= both[1] + _HALF_S or both[1] - both[0] > _GAP_S:
            raise DatasetError(
                f"{self.path}: no poses of the LiDAR within {_GAP_S} s at "
                f"{self.start_ns / 1e9 + stamp_s:.3f} s; choose frames that have them (--frames), "
                "or --motion scans"
            )
        share = (stamp_s - both[0]) / (both[1] - both[0])
        pair = self.T_world_lidar[after - 1 : after + 1]
        turn = Slerp([0, 1], Rotation.from_matrix(pair[:, :3, :3]))
        shift = (1 - share) * pair[0, :3, 3] + share * pair[1, :3, 3]
        return transform(turn(np.clip(share, 0, 1)), shift)


def _by_poses(trajectory: _Trajectory, frame: Frame, to_s: float) -> ScanMotion:
    stamp_s = ((frame.stamp_ns or 0) - trajectory.start_ns) / 1e9
    before, after = (trajectory.at(stamp_s + to_s / 2 + t) for t in (-_HALF_S, _HALF_S))
    twist = twist_between(before, after, 2 * _HALF_S)
    return ScanMotion(tuple(twist.tolist()), to_s, trajectory.at(stamp_s))


def _by_scans(frames: Sequence[Frame], frame: Frame, to_s: float) -> ScanMotion:
    """The mean velocity from the scan before to this one, and to the one after.

    Raises:
        DatasetError: if there is neither, or they do not fit.
    """
    place = next(k for k, other in enumerate(frames) if other.index == frame.index)
    beside = [*frames[max(place - 1, 0) : place], *frames[place + 1 : place + 2]]
    later_s = [(other, seconds_between(frame, other) or 0.0) for other in beside]
    near = [(other, s) for other, s in later_s if 0 < abs(s) < _NEIGHBOUR_S]
    if not near:
        raise DatasetError(
            f"{frame.cloud_path}: has no scan within {_NEIGHBOUR_S} s before or after it, from "
            "which its motion could be found; choose other frames, or --motion odometry or tf"
        )
    return ScanMotion(tuple(twist_by_scans(frame, near).tolist()), to_s)


def _odometry(bag: Bag, lidar: str, options: BagOptions) -> Iterator[tuple[int, Array]]:
    """Stamps and T_world_lidar of Odometry: the pose of its child_frame_id in its frame_id."""
    found = [topic.name for topic in bag.of_type(_ODOMETRY_TYPE)]
    named = options.topics.get(ODOMETRY)
    if named is None and len(found) != 1:
        raise DatasetError(
            f"{bag.path}: has {len(found)} topics of Odometry ({', '.join(found) or 'none'}); name "
            f"one by --topic {ODOMETRY}=/TOPIC, or use --motion tf or scans"
        )
    topic, transforms, count = named or found[0], Transforms(Drive(bag, options.beside)), 0
    for message in bag.messages([topic]):
        child, pose = message.content.child_frame_id.lstrip("/"), message.content.pose.pose
        T_child_lidar = transforms.between(child, lidar)
        if T_child_lidar is None:
            raise DatasetError(
                f"{bag.path}: no static transforms connect the LiDAR's frame {lidar!r} with "
                f"{child!r} of {topic}: {transforms.why_apart(child, lidar)}; use --motion scans"
            )
        T_world_child = pose_matrix(*values_of(pose.position, pose.orientation))
        if T_world_child is not None:
            count += 1
            yield stamp_ns_of(message.content), T_world_child @ T_child_lidar
    if not count:
        raise DatasetError(
            f"{bag.path}: no message of {topic} has a pose: their quaternions are 0 0 0 0, or not "
            "finite; use --motion tf or scans"
        )


def _moving_transforms(bag: Bag, lidar: str, options: BagOptions) -> Iterator[tuple[int, Array]]:
    """Stamps and T_parent_lidar of the /tf transforms of a frame that the LiDAR hangs from."""
    transforms = Transforms(Drive(bag, options.beside))
    for each in stamped_transforms(bag, MOVING):
        if not transforms.moving:  # the vehicle stands
            yield each.stamp_ns, np.eye(4)
        elif each.child in transforms.moving and each.T_parent_child is not None:
            T_child_lidar = transforms.between(each.child, lidar)
            if T_child_lidar is not None:
                yield each.stamp_ns, each.T_parent_child @ T_child_lidar
