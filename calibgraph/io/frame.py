"""A frame: one cloud and the images taken with it; the cloud as recorded, or without motion."""

import hashlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.files import sha256
from calibgraph.io.bags import MESSAGE_SUFFIX, hash_message
from calibgraph.io.burnt_in import BurntIn
from calibgraph.io.clouds import load_cloud, thin_cloud
from calibgraph.io.frame_files import stamp_ns_in_name
from calibgraph.io.images import load_image
from calibgraph.io.motion import (
    PreparedScan,
    ScanMotion,
    prepare_scan,
    register,
    twist_between,
)
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera

_MOST_M_S = 100.0  # of a vehicle
_MOTION = "motion"
"""The key of an entry's :class:`ScanMotion`, if its cloud is corrected."""
_COLUMNS = "cloud_columns"


class Sized(Protocol):
    """A value that knows its size in memory."""

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        ...


Derived = TypeVar("Derived", bound=Sized)


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
        burnt_in: per camera, what its images are filled at when they are loaded.
        columns: names of those of a .bin cloud, if the rig states them.
        arrays: the cloud and images by their paths, which are names, if they are in memory.

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
    burnt_in: Mapping[str, BurntIn] = field(default_factory=dict, kw_only=True, compare=False)
    columns: tuple[str, ...] | None = field(default=None, kw_only=True)
    arrays: Mapping[Path, NDArray[Any]] = field(
        default_factory=dict, kw_only=True, compare=False, repr=False
    )

    @property
    def motion(self) -> ScanMotion | None:
        """For which the cloud is corrected; None if it is as recorded."""
        return None if self.find_motion is None else self.find_motion()

    @property
    def is_corrected(self) -> bool:
        """Whether its cloud is corrected for motion."""
        return self.find_motion is not None

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
        """The stamp that names it; None if another name does."""
        stem = self.name.rpartition("/")[2]
        return int(stem) if self.cloud_path.suffix == MESSAGE_SUFFIX else stamp_ns_in_name(stem)

    @property
    def T_world_lidar(self) -> Array | None:
        """(4, 4) of the LiDAR in a frame fixed to the ground; None if no poses are given."""
        return None if self.motion is None else self.motion.T_world_lidar

    def with_burnt_in(self, found: Mapping[str, BurntIn]) -> "Frame":
        """The frame whose images are filled where something is burnt in; it is not kept."""
        own = {each.name: getattr(self, each.name) for each in fields(Frame)}
        return Frame(**{**own, "burnt_in": found})

    def load_cloud(self) -> NDArray[np.float32]:
        """(n, 4) x y z [m], intensity; see :func:`calibgraph.io.clouds.load_cloud`; thinned."""
        if self.cloud_path in self.arrays:
            return thin_cloud(self.arrays[self.cloud_path])
        return thin_cloud(load_cloud(self.cloud_path, self.motion, self.columns))

    def load_image(self, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width, 3) image, BGR; see :func:`calibgraph.io.images.load_image`."""
        path, burnt_in = self.image_paths[name], self.burnt_in.get(name)
        image = self.arrays[path] if path in self.arrays else load_image(path, camera)
        return image if burnt_in is None else burnt_in.fill(image)

    def load_gray(self, name: str, camera: Camera) -> NDArray[np.uint8]:
        """(height, width) the same image, gray."""
        gray = cv2.cvtColor(self.load_image(name, camera), cv2.COLOR_BGR2GRAY)
        return np.asarray(gray, dtype=np.uint8)

    def derive(self, key: Hashable, make: Callable[[], Derived]) -> Derived:  # noqa: ARG002
        """A value that follows from its files and the key; see ``KeptFrame``."""
        return make()

    def hashes(self) -> dict[str, str]:
        """SHA-256 of the cloud and the images, by path; computed once."""
        return self._hashes

    @cached_property
    def _hashes(self) -> dict[str, str]:
        found = {path: hashlib.sha256(a.tobytes()).hexdigest() for path, a in self.arrays.items()}
        paths = (self.cloud_path, *self.image_paths.values())
        return {str(path): found.get(path) or hash_source(path) for path in paths}

    def entry(self) -> dict[str, Any]:
        """The frame's number, files and motion if it is known, as a result keeps them."""
        files: dict[str, Any] = {
            "frame": self.index,
            "name": self.name,
            "cloud": str(self.cloud_path),
            "images": {name: str(path) for name, path in self.image_paths.items()},
        }
        if self.columns is not None:
            files[_COLUMNS] = list(self.columns)
        motion = self.motion
        if self.find_twist is not None:
            motion = ScanMotion(tuple(np.asarray(self.twist_per_s).tolist()), 0.0)
        return files if motion is None else {**files, _MOTION: motion.entry()}


class ScanSteps:
    """Steps between frames by registration: each scan is prepared once, each pair fitted once."""

    def __init__(self) -> None:
        self._scans, self._steps = dict[Path, PreparedScan](), dict[tuple[Path, Path], Array]()

    def between(self, frame: Frame, other: Frame) -> Array:
        """(4, 4) T_frame_other.

        Raises:
            DatasetError: if the scans do not fit.
        """
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
    frame: Frame,
    beside: Sequence[tuple[Frame, float]],
    steps: ScanSteps | None = None,
) -> Array:
    """(6,) mean twist between a frame's scan and those before and after, by registration.

    Args:
        frame: whose twist is wanted.
        beside: the frames before and after in the recording, or one of them, and by how much later
            they are [s].
        steps: those that are known; none.

    Raises:
        DatasetError: if there is none, scans do not fit, or the speed is beyond that of a vehicle.
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
    files = entry["frame"], entry["name"], Path(entry["cloud"]), images
    motion, columns = entry.get(_MOTION), entry.get(_COLUMNS)
    if motion is None:
        return Frame(*files, columns=columns)
    found = ScanMotion.of_entry(motion)
    return Frame(*files, find_motion=lambda: found, columns=columns)


def hash_source(path: Path) -> str:
    """SHA-256 of a file, or of a message in a bag."""
    return hash_message(path) if path.suffix == MESSAGE_SUFFIX else sha256(path)
