"""A frame: one cloud and the images taken with it; and how the LiDAR moves meanwhile."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.files import sha256
from calibgraph.io.argoverse_lidars import file_of
from calibgraph.io.bags import (
    MESSAGE_SUFFIX,
    hash_message,
    load_bag_cloud,
    load_bag_image,
)
from calibgraph.io.bags.messages import read_message
from calibgraph.io.clouds import (
    RawCloud,
    describe_cloud,
    load_cloud,
    read_returns,
    seconds_after,
    thin_cloud,
    with_intensity,
)
from calibgraph.io.frame_files import stamp_ns_in_name
from calibgraph.io.images import BurntIn, load_image, require_size
from calibgraph.memory import mmap_copy
from calibgraph.model.geometry import invert, move_points
from calibgraph.model.rig import Camera
from calibgraph.parallel import KeyedCache
from factors import displace

_COARSE_M, _FINE_M = 1.0, 0.25
_REACHES_M = 4.0, 1.0  # of both registrations: 40 m/s in 0.1 s
PreparedScan = tuple[tuple[Any, Any], tuple[Any, Any]]
"""A thinned cloud of small_gicp and its tree, coarse and fine."""


@dataclass(frozen=True)
class ScanMotion:
    """How the LiDAR moves during a scan, and the instant for which its points are wanted.

    Attributes:
        twist_per_s: rotation [rad/s] and translation [m/s] along the LiDAR's axes.
        to_s: the instant, in seconds after the stamp of the scan.
        T_world_lidar: (4, 4) at the stamp, if poses of the drive are given; not kept in results.
    """

    twist_per_s: tuple[float, ...]
    to_s: float
    T_world_lidar: Array | None = field(default=None, compare=False, repr=False)

    def correct(self, points_m: NDArray[np.floating], times_s: Array) -> Array:
        """(n, 3) where points, taken at times [s] after the stamp, would be seen at the instant."""
        points = points_m.astype(np.float64)
        return displace(points, np.array(self.twist_per_s), times_s - self.to_s)


def twist_between(T_world_before: Array, T_world_after: Array, seconds: float) -> Array:
    """(6,) rotation [rad/s] and translation [m/s] per second, from two (4, 4) poses."""
    step = gtsam.Pose3(invert(T_world_before) @ T_world_after)
    return np.asarray(gtsam.Pose3.Logmap(step) / seconds, dtype=np.float64)


def prepare_scan(points_m: Array) -> PreparedScan:
    """Thin a scan, (n, 3), for :func:`register`; this takes longer than the registration."""
    import small_gicp

    coarse, fine = (small_gicp.preprocess_points(points_m, size) for size in (_COARSE_M, _FINE_M))
    return coarse, fine


def register(target: PreparedScan, source: PreparedScan, where: Path) -> Array:
    """(4, 4) T_target_source of two scans, coarse and then fine."""
    import small_gicp

    T = np.eye(4)
    for (cloud, tree), (moved, _), reach_m in zip(target, source, _REACHES_M, strict=True):
        found = small_gicp.align(cloud, moved, tree, T, max_correspondence_distance=reach_m)
        T = np.asarray(found.T_target_source)
    if not found.converged:
        raise DatasetError(
            f"{where}: its scan and a neighbouring one do not fit, so that the motion is "
            "unknown; take neighbouring clouds of one drive, or leave --interval-s or --motion out"
        )
    return T


_INSTANT_S = 0.003  # in which all points of a cloud count as taken at once
_MOST_M_S = 100.0  # of a vehicle
_MOTION = "motion"
"""The key of an entry's :class:`ScanMotion`, if its cloud is corrected."""
_COLUMNS, _INSTANT = "cloud_columns", "instant"


Derived = TypeVar("Derived")
Number = TypeVar("Number", np.float32, np.uint8)


class Kept(NamedTuple):
    """What frames of a dataset keep, unless others came since, by their number; and in common."""

    values: KeyedCache[tuple[int, Hashable], Any]
    common: KeyedCache[Hashable, Any]


@dataclass(frozen=True)
class Frame:
    """One cloud and the images taken with it.

    Attributes:
        index: number of the frame in its dataset, the ``frame`` of its correspondences.
        name: the files' stem, or a bag's stamp; after the sequence's name if there are several.
        cloud_path: the cloud's file, or its address in a bag.
        image_paths: the image's file or address in a bag, per camera that has one.
        find_motion: computes the motion during the scan, for which the cloud is then corrected.
        find_twist: computes (6,) the twist of the LiDAR where the cloud is as recorded.
        twist: (6,) of the LiDAR, in place of one that is computed.
        lidar_paths: the clouds of other LiDARs of this instant, by name.
        burnt_in: per camera, what its images are filled at when they are loaded.
        recorded_ns: its stamp, where its name is none.
        images_after_s: per camera, by how much its image is after the stamp, where no names of
            files state it.
        columns: names of those of a .bin cloud, if the rig states them.
        joined: (4, 4) T_base_lidar of other LiDARs, whose clouds are a part of this one's.
        is_instant: the points of its clouds count as taken at the stamp, whatever their times.
        arrays: the cloud and images by their paths, which are names, if they are in memory.
        kept: gray images, the cloud and what derives of them, which may then not be written to.

    The motion and the twist are computed when they are needed, by functions that keep what they
    found.
    """

    index: int
    name: str
    cloud_path: Path
    image_paths: dict[str, Path]
    find_motion: Callable[[], ScanMotion] | None = field(default=None, kw_only=True)
    find_twist: Callable[[], Array] | None = field(default=None, kw_only=True)
    twist: Array | None = field(default=None, kw_only=True, compare=False)
    lidar_paths: Mapping[str, Path] = field(default_factory=dict, kw_only=True)
    burnt_in: Mapping[str, BurntIn] = field(default_factory=dict, kw_only=True, compare=False)
    recorded_ns: int | None = field(default=None, kw_only=True)
    images_after_s: Mapping[str, float] = field(default_factory=dict, kw_only=True, compare=False)
    columns: tuple[str, ...] | None = field(default=None, kw_only=True)
    joined: Mapping[str, Array] = field(default_factory=dict, kw_only=True, compare=False)
    is_instant: bool = field(default=False, kw_only=True)
    arrays: Mapping[Path, NDArray[Any]] = field(
        default_factory=dict, kw_only=True, compare=False, repr=False
    )
    kept: Kept | None = field(default=None, kw_only=True, compare=False, repr=False)

    @property
    def motion(self) -> ScanMotion | None:
        """For which the cloud is corrected; None if it is as recorded."""
        return None if self.find_motion is None else self.find_motion()

    @property
    def twist_per_s(self) -> Array | None:
        """(6,) of the LiDAR: rotation [rad/s], translation [m/s]; None if it is unknown."""
        if self.twist is not None:
            return self.twist
        if self.find_twist is not None:
            return self.find_twist()
        return None if self.motion is None else np.array(self.motion.twist_per_s)

    @property
    def stamp_ns(self) -> int | None:
        """The stamp that names it, or that is stated beside it; None without."""
        if self.recorded_ns is not None:
            return self.recorded_ns
        stem = self.name.rpartition("/")[2]
        return int(stem) if self.cloud_path.suffix == MESSAGE_SUFFIX else stamp_ns_in_name(stem)

    @property
    def T_world_lidar(self) -> Array | None:
        """(4, 4) of the LiDAR in a frame fixed to the ground; None if no poses are given."""
        return None if self.motion is None else self.motion.T_world_lidar

    def at_instant(self) -> Frame:
        """The frame with clouds of an instant: moved as a whole, if the times of images are known.

        They are not kept.
        """
        after_s = [self.image_after_s(name) for name in self.image_paths]
        find = self.find_motion if after_s and None not in after_s else None
        return replace(self, is_instant=True, find_motion=find, kept=None)

    def with_burnt_in(self, found: Mapping[str, BurntIn]) -> Frame:
        """The frame whose images are filled where something is burnt in; it is not kept."""
        return replace(self, burnt_in=found, kept=None)

    def load_cloud(self) -> NDArray[np.float32]:
        """(n, 4) x y z [m], intensity; see :func:`calibgraph.io.clouds.load_cloud`; thinned."""
        return self._keep("cloud", self._load_cloud)

    def _load_cloud(self) -> NDArray[np.float32]:
        path, motion = self.cloud_path, self.motion
        if path.suffix == MESSAGE_SUFFIX:
            timed = motion is not None and not self.is_instant
            cloud, times_s = load_bag_cloud(path, timed=timed)
            if motion is not None:
                taken_s = np.zeros(len(cloud)) if times_s is None else times_s
                cloud[:, :3] = motion.correct(cloud[:, :3], taken_s)
            found = with_intensity(cloud)
        else:
            found = self.arrays[path] if path in self.arrays else load_cloud(path, self.columns)
            if motion is not None and self.is_instant:
                found[:, :3] = motion.correct(found[:, :3], np.zeros(len(found)))
            elif motion is not None and (sweep := self._sweep_of("")) is not None:
                found[:, :3] = motion.correct(*sweep)
        return thin_cloud(self._join(found) if self.joined else found)

    def load_in_base(self, lidar: str) -> NDArray[np.float32] | None:
        """(n, 4) the cloud of a joined LiDAR in the frame of the base, corrected as its cloud is.

        None where the vehicle is known to move, and its points have no times.
        """
        motion = self.motion
        timed = motion is not None and not self.is_instant
        cloud, times_s = self._load_returns(lidar, timed=timed)
        points = move_points(cloud[:, :3].astype(np.float64), self.joined[lidar])
        if motion is not None:
            times_s = np.zeros(len(points)) if self.is_instant else times_s
            if times_s is None:
                return None
            points = motion.correct(points, times_s)
        return np.column_stack([points, cloud[:, 3]]).astype(np.float32)

    def _join(self, base: NDArray[np.float32]) -> NDArray[np.float32]:
        """The clouds of the base and of other LiDARs; intensities are ranks within each cloud."""
        parts = [base, *(of for n in self.joined if (of := self.load_in_base(n)) is not None)]
        for part in parts:
            ordered, own = np.sort(part[:, 3]), part[:, 3].copy()
            part[:, 3] = np.searchsorted(ordered, own) + np.searchsorted(ordered, own, "right")
            part[:, 3] /= 2 * max(len(part), 1)
        return np.concatenate(parts)

    def load_recorded(self, lidar: str, *, timed: bool) -> tuple[Array, Array | None]:
        """(n, 3) the cloud of one of several LiDARs, as it was recorded, in its own frame.

        And, if asked, (n,) the times of its points [s] after the frame's stamp; None without.
        """
        cloud, times_s = self._load_returns(lidar, timed=timed)
        return cloud[:, :3].astype(np.float64), times_s

    def _load_returns(self, lidar: str, *, timed: bool) -> tuple[NDArray[np.float32], Array | None]:
        path, times_s = self.lidar_paths.get(lidar, self.cloud_path), None
        if path.suffix == MESSAGE_SUFFIX:
            return load_bag_cloud(path, timed=timed, start_ns=self.stamp_ns)
        found = read_returns(path, self.columns if path == self.cloud_path else None)
        if timed and found.times is not None:
            times_s = seconds_after(self.stamp_ns, found.times, str(path))
        return with_intensity(found.points), times_s

    def load_sweep(self) -> tuple[Array, Array] | None:
        """(n, 3) the points as recorded, and (n,) their times [s] after the stamp; None without.

        Times that are all equal, or of no scan, are none. Joined clouds are a part.
        """
        own = self._sweep_of("")
        if own is None or not self.joined:
            return own
        others = {name: self._sweep_of(name) for name in self.joined}
        parts = [
            (move_points(of[0], self.joined[name]), of[1]) for name, of in others.items() if of
        ]
        points, times_s = zip(own, *parts, strict=True)
        return np.concatenate(points), np.concatenate(times_s)

    def _sweep_of(self, lidar: str) -> tuple[Array, Array] | None:
        if self.cloud_path in self.arrays or self.is_instant:
            return None
        with suppress(DatasetError):  # numbers that are no times of one scan
            points, times_s = self.load_recorded(lidar, timed=True)
            if times_s is not None and np.ptp(times_s) > _INSTANT_S:
                return points, times_s
        return None

    def image_after_s(self, camera: str) -> float | None:
        """By how much an image is after the stamp, as their names or messages have it."""
        if camera in self.images_after_s:
            return self.images_after_s[camera]
        path, stamp_ns = self.image_paths.get(camera), self.stamp_ns
        taken_ns = None if path is None else stamp_ns_in_name(path.stem)
        return None if taken_ns is None or stamp_ns is None else (taken_ns - stamp_ns) / 1e9

    def describe_cloud(self) -> list[str]:
        """Notes about its cloud; none if it cannot be read, which is named where it is loaded."""
        path = self.cloud_path
        try:
            if path.suffix == MESSAGE_SUFFIX:
                fields = tuple(each.name for each in read_message(path)[1].fields)
                cloud = RawCloud(load_bag_cloud(path)[0], fields)
            else:
                cloud = read_returns(path, self.columns)
        except (CalibrationError, OSError):
            return []
        return list(describe_cloud(str(path), cloud))

    def load_image(self, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width, 3) image, BGR; see :func:`calibgraph.io.images.load_image`."""
        path, burnt_in = self.image_paths[name], self.burnt_in.get(name)
        if path.suffix == MESSAGE_SUFFIX:
            image = load_bag_image(path)
            require_size(path, image.shape[1::-1], camera)
        else:
            image = self.arrays[path] if path in self.arrays else load_image(path, camera)
        return image if burnt_in is None else burnt_in.fill(image)

    def load_gray(self, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width) the same image, gray."""

        def load() -> NDArray[np.uint8]:
            gray = cv2.cvtColor(self.load_image(name, camera), cv2.COLOR_BGR2GRAY)
            return np.asarray(gray, dtype=np.uint8)

        return self._keep(("gray", name), load)

    def _keep(self, key: Hashable, load: Callable[[], NDArray[Number]]) -> NDArray[Number]:
        return load() if self.kept is None else self.derive(key, lambda: mmap_copy(load()))

    def derive(self, key: Hashable, make: Callable[[], Derived]) -> Derived:
        """What follows from its files and the key; made once if frames are kept."""
        found: Derived = self.kept.values.get((self.index, key), make) if self.kept else make()
        return found

    def derive_for_all(self, key: Hashable, make: Callable[[], Derived]) -> Derived:
        """What kept frames of a dataset have in common, made once. It bounds its own memory."""
        found: Derived = self.kept.common.get(key, make) if self.kept else make()
        return found

    def hashes(self) -> dict[str, str]:
        """SHA-256 of the cloud and the images, by path; computed once if frames are kept."""
        paths = (self.cloud_path, *self.image_paths.values(), *self.lidar_paths.values())

        def compute() -> dict[str, str]:
            known = {p: hashlib.sha256(a.tobytes()).hexdigest() for p, a in self.arrays.items()}
            return {str(path): known.get(path) or hash_source(path) for path in paths}

        return self.derive_for_all(("hashes", self.index), compute)

    def entry(self) -> dict[str, Any]:
        """The frame's number, files and motion if it is known, as a result keeps them."""
        files: dict[str, Any] = {
            "frame": self.index,
            "name": self.name,
            "cloud": str(self.cloud_path),
            "images": {name: str(path) for name, path in self.image_paths.items()},
        }
        if self.lidar_paths:
            files["lidars"] = {name: str(path) for name, path in self.lidar_paths.items()}
        if self.joined:
            files["joined"] = {name: T.tolist() for name, T in self.joined.items()}
        if self.columns is not None:
            files[_COLUMNS] = list(self.columns)
        motion = self.motion
        if motion is None and self.find_twist is not None:
            motion = ScanMotion(tuple(np.asarray(self.twist_per_s).tolist()), 0.0)
        if motion is not None:
            files[_MOTION] = {"twist_per_s": list(motion.twist_per_s), "to_s": motion.to_s}
            files |= {_INSTANT: True} if self.is_instant and self.find_motion else {}
        return files


def frames_by_stem(
    clouds: Mapping[str, Path],
    images: Mapping[str, Mapping[str, Path]],
    lidars: Mapping[str, Mapping[str, Path]] | None = None,
) -> list[Frame]:
    """A frame per cloud, with the images and the clouds of other LiDARs that have its stem."""

    def having(stem: str, files: Mapping[str, Mapping[str, Path]]) -> dict[str, Path]:
        return {name: of[stem] for name, of in files.items() if stem in of}

    return [
        Frame(n, stem, cloud, having(stem, images), lidar_paths=having(stem, lidars or {}))
        for n, (stem, cloud) in enumerate(clouds.items())
    ]


class ScanSteps:
    """Steps between frames by registration: each scan is prepared once, each pair fitted once."""

    def __init__(self) -> None:
        self._scans, self._steps = dict[Path, PreparedScan](), dict[tuple[Path, Path], Array]()

    def between(self, frame: Frame, other: Frame) -> Array:
        """(4, 4) T_frame_other."""
        one, two = frame.cloud_path, other.cloud_path
        if (two, one) in self._steps:
            return invert(self._steps[two, one])
        if (one, two) not in self._steps:
            self._steps[one, two] = register(self._prepared(frame), self._prepared(other), one)
        return self._steps[one, two]

    def _prepared(self, frame: Frame) -> PreparedScan:
        if frame.cloud_path not in self._scans:
            points = frame.load_cloud()[:, :3].astype(np.float64)
            self._scans[frame.cloud_path] = prepare_scan(points)
        return self._scans[frame.cloud_path]


def twist_by_scans(
    frame: Frame, beside: Sequence[tuple[Frame, float]], steps: ScanSteps | None = None
) -> Array:
    """(6,) mean twist between a frame's scan and those before and after, by registration.

    They are given with how much later they are [s]. Known steps are not computed again.
    """
    if not beside:
        raise DatasetError(
            f"{frame.cloud_path}: has no neighbouring scan, which its motion is found from; give "
            "two frames or more, or leave --interval-s out"
        )
    steps = steps or ScanSteps()
    twists = [
        twist_between(np.eye(4), steps.between(frame, one), later_s) for one, later_s in beside
    ]
    twist = np.asarray(np.mean(twists, axis=0))
    if (speed_m_s := np.linalg.norm(twist[3:])) > _MOST_M_S:
        raise DatasetError(
            f"{frame.cloud_path}: by its neighbours, the LiDAR moves at {speed_m_s:.0f} m/s, more "
            f"than {_MOST_M_S:g}; correct the stamps of the clouds, or --interval-s"
        )
    return twist


def seconds_between(one: Frame, other: Frame) -> float | None:
    """How much later another frame was recorded, by the stamps that name both; None without."""
    first, second = one.stamp_ns, other.stamp_ns
    return None if first is None or second is None else (second - first) / 1e9


def frame_of_entry(entry: Mapping[str, Any]) -> Frame:
    """The frame that a result's entry names, its cloud corrected as it was."""
    images = {name: Path(path) for name, path in entry["images"].items()}
    lidars = {name: Path(path) for name, path in entry.get("lidars", {}).items()}
    files = entry["frame"], entry["name"], Path(entry["cloud"]), images
    joined = {name: np.array(T) for name, T in entry.get("joined", {}).items()}
    frame = Frame(*files, lidar_paths=lidars, columns=entry.get(_COLUMNS), joined=joined)
    if (motion := entry.get(_MOTION)) is None:
        return frame
    found = ScanMotion(tuple(motion["twist_per_s"]), motion["to_s"])
    return replace(frame, find_motion=lambda: found, is_instant=entry.get(_INSTANT, False))


def hash_source(path: Path) -> str:
    """SHA-256 of a file, or of a message in a bag."""
    return hash_message(path) if path.suffix == MESSAGE_SUFFIX else sha256(file_of(path))
