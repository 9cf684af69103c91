"""The frames of a bag: each cloud with the nearest images, corrected for the LiDAR's motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.io.bags.camera_info import StatedLens, lens_of
from calibgraph.io.bags.messages import Bag, open_drive, read_message
from calibgraph.io.bags.point_clouds import doubtful_time_fields
from calibgraph.io.bags.stamps import (
    TopicStamps,
    after_ns,
    describe_offsets,
    describe_spans,
    nearest,
    offsets_of,
    read_messages,
)
from calibgraph.io.bags.storage import ODOMETRY, BagOptions, Motion
from calibgraph.io.bags.topics import RigTopics, choose_topics, is_rectified
from calibgraph.io.bags.transforms import (
    MOVING,
    Transforms,
    pose_matrix,
    stamp_ns_of,
    stamped_transforms,
    values_of,
)
from calibgraph.io.clouds import time_fields
from calibgraph.io.frame import Frame, ScanMotion, seconds_between, twist_between, twist_by_scans
from calibgraph.io.rig_parts import Link
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera

MotionOf = Callable[[Frame, float], ScanMotion]
"""Finds the motion of a frame, at a time [s] after its stamp."""

_ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
_HALF_S = 0.05  # half a turn of a LiDAR at 10 Hz: the velocity is the mean of a scan
_GAP_S = 0.5
"""Poses farther apart are not interpolated: at 2 m/s^2 the mean is off by 0.25 m/s, 1 cm a scan."""
_NEIGHBOUR_S = 0.35  # of a scan, that is registered with it


def motion_finder(path: Path, frames: Sequence[Frame], options: BagOptions) -> MotionOf:
    """A function of a frame, as recorded, that returns the motion during its scan."""
    if options.motion == "scans":
        return partial(_by_scans, frames)
    bag = Bag(path)
    lidar = read_message(frames[0].cloud_path)[1].header.frame_id.lstrip("/")
    poses = _odometry if options.motion == "odometry" else _moving_transforms
    return partial(motion_by_poses, Trajectory.of(path, poses(bag, lidar, options)))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the LiDAR in a fixed frame: (n,) stamps [s] after the first [ns], and (n, 4, 4)."""

    path: Path
    start_ns: int
    stamps_s: Array
    T_world_lidar: Array

    @staticmethod
    def of(path: Path, poses: Iterator[tuple[int, Array]]) -> Trajectory:
        """Of stamps [ns] and poses in any order; of several with one stamp, the last."""
        by_stamp = dict(sorted(dict(poses).items()))
        if len(by_stamp) < 2:  # noqa: PLR2004
            raise DatasetError(f"{path}: has {len(by_stamp)} poses of the LiDAR; --motion needs "
                               "those of the drive, or --motion scans")  # fmt: skip
        start_ns = next(iter(by_stamp))
        stamps = np.array([stamp - start_ns for stamp in by_stamp], np.float64) / 1e9
        return Trajectory(path, start_ns, stamps, np.array(list(by_stamp.values())))

    def at(self, stamp_s: float) -> Array:
        """(4, 4) between the poses before and after."""
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


def motion_by_poses(trajectory: Trajectory, frame: Frame, to_s: float) -> ScanMotion:
    """The motion of a frame's scan, from poses about its stamp."""
    stamp_s = ((frame.stamp_ns or 0) - trajectory.start_ns) / 1e9
    before, after = (trajectory.at(stamp_s + to_s / 2 + t) for t in (-_HALF_S, _HALF_S))
    twist = twist_between(before, after, 2 * _HALF_S)
    return ScanMotion(tuple(twist.tolist()), to_s, trajectory.at(stamp_s))


def _by_scans(frames: Sequence[Frame], frame: Frame, to_s: float) -> ScanMotion:
    """The mean velocity from the scan before to this one, and to the one after."""
    place = next(k for k, other in enumerate(frames) if other.index == frame.index)
    near = scans_beside(frames, place)
    if not near:
        raise DatasetError(
            f"{frame.cloud_path}: has no scan within {_NEIGHBOUR_S} s before or after it, from "
            "which its motion could be found; choose other frames, or --motion odometry or tf"
        )
    return ScanMotion(tuple(twist_by_scans(frame, near).tolist()), to_s)


def scans_beside(frames: Sequence[Frame], place: int) -> list[tuple[Frame, float]]:
    """The frames before and after one whose scans are near in time, and how much later [s]."""
    beside = [*frames[max(place - 1, 0) : place], *frames[place + 1 : place + 2]]
    later_s = [(other, seconds_between(frames[place], other) or 0.0) for other in beside]
    return [(other, s) for other, s in later_s if 0 < abs(s) < _NEIGHBOUR_S]


def _odometry(bag: Bag, lidar: str, options: BagOptions) -> Iterator[tuple[int, Array]]:
    """Stamps and T_world_lidar of Odometry: the pose of its child_frame_id in its frame_id."""
    found = [topic.name for topic in bag.of_type(_ODOMETRY_TYPE)]
    named = options.topics.get(ODOMETRY)
    if named is None and len(found) != 1:
        raise DatasetError(
            f"{bag.path}: has {len(found)} topics of Odometry ({', '.join(found) or 'none'}); name "
            f"one by --topic {ODOMETRY}=/TOPIC, or use --motion tf or scans"
        )
    topic, transforms, count = named or found[0], Transforms(open_drive(bag, options.beside)), 0
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
    transforms = Transforms(open_drive(bag, options.beside))
    for stamp_ns, child, link in stamped_transforms(bag, MOVING):
        if not transforms.moving:  # the vehicle stands
            yield stamp_ns, np.eye(4)
        elif child in transforms.moving and isinstance(link, Link):
            T_child_lidar = transforms.between(child, lidar)
            if T_child_lidar is not None:
                yield stamp_ns, link.T_parent_child @ T_child_lidar


_S = 1_000_000_000
Rows = NDArray[np.int64]


class FoundFrames(NamedTuple):
    """The frames of a bag or folder.

    Attributes:
        chosen: those that ``every_s`` picks; all without it.
        recorded: all that were read and are complete, in the order of recording. Their index counts
            the clouds that were read, and goes on by one more wherever others were not: the frames
            before and after in the recording have the numbers before and after.
        notes: how many there are, how far apart their stamps are, and how many messages were left
            out, and why.
        late_s: per camera, (n,) times of its images after the instant that a cloud is corrected to.
    """

    chosen: tuple[Frame, ...]
    recorded: tuple[Frame, ...]
    notes: tuple[str, ...]
    late_s: Mapping[str, Array] = {}


def frames_of_bag(
    path: Path,
    cameras: Mapping[str, Camera],
    options: BagOptions,
    *,
    lidars: Sequence[str] = (),
    start: int = 0,
    prefix: str = "",
) -> FoundFrames:
    """Pair the clouds of a bag with its images, without keeping any of them.

    Of several LiDARs, the base first, its clouds are paired with those of the others, too. The
    first frame has the index ``start``; names are stamps behind the prefix.
    """
    bag = Bag(path)
    topics = choose_topics(bag, options.topics, [*cameras], lidars=lidars)
    images = topics.paired
    stamps, others = _read(bag, topics, options)
    clouds = stamps[topics.lidar]
    tolerance_ns = round(options.sync_tolerance_s * _S)
    pairs = {n: nearest(clouds, stamps[topic], tolerance_ns) for n, topic in images.items()}
    complete = np.flatnonzero(np.all([rows >= 0 for rows in pairs.values()], axis=0))
    summary = _summary(stamps, topics, pairs, complete, options=options)
    if not len(complete):
        raise DatasetError(f"{path}: {summary}; {_advice(stamps, topics, pairs)}")
    summary += "".join(
        f"; {name}: {count} camera_info have another lens than the first: choose frames of one lens"
        for name, count in others.items() if count
    )  # fmt: skip
    _, cells = np.unique(np.array(clouds.cells)[complete], return_inverse=True)
    after_s = {n: after_ns(clouds, stamps[images[n]], pairs[n], complete) / _S for n in cameras}
    recorded = tuple(
        Frame(
            start + int(row + cell),
            f"{prefix}{clouds.stamp_ns[row]}",
            clouds.paths[row],
            {name: stamps[images[name]].paths[pairs[name][row]] for name in cameras},
            lidar_paths={n: stamps[t].paths[pairs[n][row]] for n, t in topics.lidars.items()},
            images_after_s={name: float(own[number]) for name, own in after_s.items()},
        )
        for number, (row, cell) in enumerate(zip(complete, cells, strict=True))
    )
    late_s = dict[str, Array]()
    if options.motion != "none":
        to_s = np.median([*after_s.values()], axis=0) if after_s else np.zeros(len(complete))
        late_s = {name: own - to_s for name, own in after_s.items()}
        find = motion_finder(path, recorded, options)
        recorded = tuple(
            replace(frame, find_motion=cache(partial(find, frame, float(s))))
            for frame, s in zip(recorded, to_s, strict=True)
        )
    chosen = recorded
    if options.every_s:
        of_cells = (np.flatnonzero(cells == cell) for cell in range(len(set(cells))))
        chosen = tuple(recorded[rows[len(rows) // 2]] for rows in of_cells)  # with neighbours
    note = f"{path}: {summary}{_note(clouds, options.motion)}"
    return FoundFrames(chosen, recorded, (note,), late_s)


def _read(
    bag: Bag, topics: RigTopics, options: BagOptions
) -> tuple[dict[str, TopicStamps], Counter[str]]:
    """The stamps of clouds and images by topic, and how many lenses of a camera are other ones."""
    stamps = {t: TopicStamps() for t in (topics.lidar, *topics.paired.values())}
    infos = {info: name for name, info in topics.infos.items() if bag.has(info)}
    first, others = dict[str, StatedLens](), Counter[str]()
    for cell, message in read_messages(bag, [*stamps], options.every_s, infos):
        if message.topic in stamps:
            stamps[message.topic].add(message, cell, bag, options.stamps)
            continue
        name = infos[message.topic]
        with suppress(FileError):  # some drivers begin with zeros
            rectified = is_rectified(topics.images[name])
            lens = lens_of(message.content, f"{bag.path}", rectified=rectified)
            others[name] += not lens.agrees(first.setdefault(name, lens))
    return stamps, others


def _note(clouds: TopicStamps, motion: Motion) -> str:
    """How clouds are corrected for motion, or what to do if points have times."""
    (names, _), *others = clouds.fields.most_common()
    times, doubtful = time_fields(names), doubtful_time_fields(names)
    note = f"; {sum(n for _, n in others)} clouds have other fields" if others else ""
    unread = f"{', '.join(doubtful)} may be times of points, which are read from t, time, timestamp"
    if motion != "none":
        of = times[0] if times else "stamp of the cloud"
        note += f"; clouds are corrected for motion by {motion}, with the {of}"
        note += "" if times else f", as {unread}" if doubtful else ", as points have no times"
    elif times:
        note += (
            f"; points have a {times[0]}: unless they are corrected for motion, give --motion "
            "odometry, tf or scans, or stand still"
        )
    elif doubtful:
        note += f"; {unread}: rename the field if they are"
    return note


def _summary(
    stamps: Mapping[str, TopicStamps],
    topics: RigTopics,
    pairs: Mapping[str, Rows],
    complete: Rows,
    *,
    options: BagOptions,
) -> str:
    """How many frames there are, how far apart their stamps are, and what was left out."""
    clouds = stamps[topics.lidar]
    kinds = ["images"] * bool(topics.images) + ["clouds of other LiDARs"] * bool(topics.lidars)
    parts = [
        f"{len(clouds.paths)} clouds, {len(complete)} with all {' and '.join(kinds)} within "
        f"{options.sync_tolerance_s:g} s"
    ]
    for name, rows in pairs.items():
        images = stamps[topics.paired[name]]
        if len(complete):
            ahead_ms = after_ns(clouds, images, rows, complete) / 1e6
            most = np.abs(ahead_ms).max()
            parts.append(f"{name} {np.median(ahead_ms):+.0f} ms (median), at most {most:.0f}")
        if np.any(rows < 0):
            what = "a cloud" if name in topics.lidars else "an image"
            parts.append(f"{np.sum(rows < 0)} without {what} of {name}")
    parts += [
        f"{topic}: {count} {what}"
        for topic, each in stamps.items()
        for what, count in each.left_out.items()
    ]
    return "; ".join(parts)


def _advice(stamps: Mapping[str, TopicStamps], topics: RigTopics, pairs: Mapping[str, Rows]) -> str:
    """What to do if no frame is complete."""
    for topic in stamps:
        if not stamps[topic].paths:
            return f"{topic} has nothing to use; choose another topic"
    worst = min(pairs, key=lambda name: int(np.sum(pairs[name] >= 0)))
    apart = offsets_of(stamps[topics.lidar], stamps[topics.paired[worst]])
    if len(apart):
        return (
            f"the nearest images of {describe_offsets(worst, apart)}; set stamps: record in "
            "--config if the clocks differ, or a larger sync_tolerance_s if that is acceptable"
        )
    both = {topic: stamps[topic] for topic in (topics.lidar, topics.paired[worst])}
    return (
        f"the stamps of {describe_spans(both)} do not meet; set stamps: record in --config if "
        "the clocks differ, or a larger sync_tolerance_s"
    )
