"""The rig of a bag: lenses from camera_info, the guess from tf_static."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.files import checked_model
from calibgraph.io.bags.camera_info import StatedLens, lens_of, stated_baseline
from calibgraph.io.bags.messages import CAMERA_INFO, Bag, Drive
from calibgraph.io.bags.options import BagOptions
from calibgraph.io.bags.topics import CameraTopics, choose_topics
from calibgraph.io.bags.transforms import Transforms
from calibgraph.io.mounts import find_mounts
from calibgraph.model.geometry import angle_deg, relative_transform
from calibgraph.model.rig import Camera, Mount, RelativePose, Rig

_UPWARD = 0.9
"""Vertical part of a camera's axis (64 deg), beyond which it looks up: z is up in body axes."""
_MOST_WITHOUT_LENS = 100  # messages at the start, each of which may be in a chunk of its own
_LEAST_BASELINE_M = 1e-3
_AT_ONE_PLACE = 0.05
"""Of a stated baseline: frames of /tf_static that are nearer to each other leave it out."""


@dataclass(frozen=True, eq=False)
class BagCamera:
    """A camera of a bag.

    Attributes:
        stated: the lens in its CameraInfo.
        T_camera_lidar: (4, 4); None if no static transforms connect it with the LiDAR.
        mount: the link of the tree that a calibration changes; None if there is none but itself.
        frame_id: of its image, if the frame has the image's axes and origin.
        with_baseline: whether its place is its frame's, and the baseline that its P states.
        where: its CameraInfo, for errors.
    """

    stated: StatedLens
    T_camera_lidar: Array | None
    frame_id: str | None
    with_baseline: bool
    where: str
    mount: Mount | None = None

    @property
    def T_camera_frame(self) -> Array:
        """(4, 4) from the frame in the tree."""
        return self.stated.T_image_frame(with_baseline=self.with_baseline)


@dataclass(frozen=True, eq=False)
class BagRig:
    """What a bag holds about its rig; extrinsics may be missing.

    Attributes:
        lidar: the LiDAR's frame.
        cameras: by name.
        transforms: of the bag and those beside it.
        notes: what was left out, added or taken from elsewhere, a line each.
    """

    path: Path
    lidar: str
    cameras: Mapping[str, BagCamera]
    transforms: Transforms
    notes: tuple[str, ...]

    def to_rig(self, relative_sigmas: tuple[float, float] | None = None) -> Rig:
        """The rig; arguments as of :func:`rig_of_bag`.

        Raises:
            DatasetError: if an extrinsic is missing.
            FileError: if a value is no camera's.
        """
        shared = _shared_frames(self.cameras)
        if relative_sigmas is not None and shared:
            frame, names = next(iter(shared.items()))
            raise DatasetError(
                f"{self.path}: {' and '.join(names)} name one frame, {frame!r}, so their relative "
                "pose is not known and cannot be taken as measured; leave out --tie-deg and "
                "--tie-m, or write relative_poses into the rig file"
            )
        cameras = {
            name: checked_model(Camera, self._content(name), camera.where)
            for name, camera in self.cameras.items()
        }
        content = {
            "lidar": self.lidar,
            "cameras": cameras,
            "relative_poses": _relative_poses(cameras, relative_sigmas),
        }
        return checked_model(Rig, content, self.path)

    def _content(self, name: str) -> dict[str, Any]:
        """The fields of a Camera."""
        camera = self.cameras[name]
        if camera.T_camera_lidar is None:
            frame = camera.stated.frame
            raise DatasetError(
                f"{camera.where}: no static transforms connect the LiDAR's frame {self.lidar!r} "
                f"with the frame {frame!r} of camera {name!r}: "
                f"{self.transforms.why_apart(frame, self.lidar)}. If another bag of the drive has "
                "them, give it too; else describe the mounting with calibgraph rig BAG --mount "
                f"{quote(name)}=WORDS --out rig.yaml, or add a URDF: calibgraph rig BAG car.urdf "
                "--out rig.yaml; then calibrate with --rig rig.yaml",
                camera=name,
            )
        extrinsic = {
            "frame_id": camera.frame_id,
            "mount": camera.mount,
            "T_camera_lidar": camera.T_camera_lidar,
        }
        return {**camera.stated.lens.fields(), **extrinsic}


def read_bag_rig(path: Path, options: BagOptions | None = None) -> BagRig:
    """What a bag holds about its rig; extrinsics may be missing."""
    options = options or BagOptions()
    bag = Bag(path)
    drive = Drive(bag, options.beside)
    chosen = choose_topics(bag, options.topics, drive=drive)
    lidar = bag.first(chosen.lidar).header.frame_id.lstrip("/")
    reader = _CameraReader(drive, lidar)
    cameras = {name: reader.read(name, topics) for name, topics in chosen.cameras.items()}
    counts = Counter([lidar, *(camera.frame_id for camera in cameras.values())])
    cameras = {
        name: camera if counts[camera.frame_id] == 1 else replace(camera, frame_id=None)
        for name, camera in cameras.items()
    }
    hanging = {
        name: (camera.stated.frame, camera.T_camera_frame)
        for name, camera in cameras.items()
        if camera.T_camera_lidar is not None
    }
    mounts = find_mounts(hanging, lidar, reader.transforms.parents, reader.transforms.known)
    cameras = {name: replace(camera, mount=mounts.get(name)) for name, camera in cameras.items()}
    shared = (
        f"{path}: {' and '.join(names)} name one frame, {frame!r}: at most one of them is there"
        for frame, names in _shared_frames(cameras).items()
    )
    notes = (*chosen.notes, *reader.transforms.notes, *reader.notes, *shared)
    return BagRig(path, lidar, cameras, reader.transforms, notes)


def rig_of_bag(
    path: Path | str,
    options: BagOptions | None = None,
    *,
    relative_sigmas: tuple[float, float] | None = None,
) -> Rig:
    """The rig that a bag describes: lenses from CameraInfo, T_camera_lidar from /tf_static.

    The frames are those that the messages name: the camera's optical frame (x right, y down, z
    forward) in its CameraInfo, the LiDAR's in its clouds.

    Args:
        path: the bag.
        options: which topics; those found by type if None.
        relative_sigmas: make the cameras' relative poses in /tf_static measurements, of these
            sigmas in rotation [rad] and translation [m]. None: they are only a guess, as what is
            drawn in a URDF has not been measured.

    Raises:
        FileError, DatasetError: if the bag is damaged, or a topic, a lens or a transform missing.
    """
    return read_bag_rig(Path(path), options).to_rig(relative_sigmas)


def doubtful_axes(rig: Rig) -> list[str]:
    """A line for each camera that looks straight up, as with body axes for optical ones."""
    return [
        f"{name} looks straight up: is the frame of its camera_info optical, z ahead and y down?"
        for name, T_camera_lidar in rig.T_camera_lidar.items()
        if T_camera_lidar[2, 2] > _UPWARD
    ]


class _CameraReader:
    """Reads the cameras of a bag of a drive."""

    def __init__(self, drive: Drive, lidar: str) -> None:
        self._drive, self._lidar = drive, lidar
        self.transforms = Transforms(drive)
        self.notes: list[str] = []

    def read(self, name: str, topics: CameraTopics) -> BagCamera:
        """A camera; its extrinsic may be missing.

        Raises:
            DatasetError: if it has no CameraInfo.
            FileError: if it is not calibrated.
        """
        if topics.info is None:
            raise DatasetError(
                f"{self._drive.bag.path}: {_why_no_info(name, topics)}, or calibrate "
                f"with a rig that has the lens of camera {name!r} (--rig)",
                camera=name,
            )
        bag = next(bag for bag in self._drive if bag.has(topics.info))
        if bag is not self._drive.bag:
            self.notes.append(f"{self._drive.bag.path}: {topics.info} is that of {bag.path}")
        where = f"{bag.path}: {topics.info}"
        lens = _first_lens(bag, topics, where)
        with_baseline = self._counts_baseline(name, lens, bag, topics.info)
        T_frame_lidar = self.transforms.between(lens.frame, self._lidar)
        T_image_frame = lens.T_image_frame(with_baseline=with_baseline)
        T_camera_lidar = None if T_frame_lidar is None else T_image_frame @ T_frame_lidar
        if lens.is_turned and not with_baseline:
            self.notes.append(
                f"{name}: its images are rectified, and turned by "
                f"{angle_deg(lens.R_image_frame):.2g} deg against frame {lens.frame!r}; an export "
                "has a frame of their own"
            )
        frame_id = None if lens.is_turned or with_baseline else lens.frame or None
        return BagCamera(lens, T_camera_lidar, frame_id, with_baseline, where)

    def _counts_baseline(self, name: str, lens: StatedLens, bag: Bag, info: str) -> bool:
        """Whether the frame of a second camera is at the place of the first, not at its own."""
        length_m = float(np.linalg.norm(lens.baseline_m))
        if length_m < _LEAST_BASELINE_M:
            return False
        first = self._first_of_pair(lens.frame, length_m, bag, info)
        stated = f"{name}: P of its camera_info states a baseline of {length_m:.3f} m"
        if first is None:
            self.notes.append(f"{stated}; frame {lens.frame!r} is its own, so it is not added")
        else:
            self.notes.append(
                f"{stated}; it is added, as frame {lens.frame!r} is at that of {first}"
            )
        return first is not None

    def _first_of_pair(self, frame: str, length_m: float, bag: Bag, info: str) -> str | None:
        """The CameraInfo without a baseline whose frame is at the place of this one."""
        for topic in bag.of_type(CAMERA_INFO):
            message = bag.first(topic.name) if topic.name != info else None
            if message is None or np.linalg.norm(stated_baseline(message)) >= _LEAST_BASELINE_M:
                continue
            T = self.transforms.between(frame, message.header.frame_id.lstrip("/"))
            if T is not None and np.linalg.norm(T[:3, 3]) < _AT_ONE_PLACE * length_m:
                return topic.name
        return None


def _why_no_info(name: str, topics: CameraTopics) -> str:
    """Why no CameraInfo is an image's, and what to do."""
    if not topics.infos:
        return f"{topics.image} has no camera_info beside it; record it"
    also = f", which may be that of {', '.join(topics.rivals)} too" if topics.rivals else ""
    return (
        f"which camera_info is that of {topics.image}? There is {', '.join(topics.infos)}{also}; "
        f"name both: --topic {quote(name)}={topics.image},/CAMERA_INFO"
    )


def _first_lens(bag: Bag, topics: CameraTopics, where: str) -> StatedLens:
    """The lens of the first CameraInfo that has one: some drivers begin with zeros.

    Raises:
        FileError: why the first has none, if no other has.
    """
    error: FileError | None = None
    for message in islice(bag.messages([topics.infos[0]]), _MOST_WITHOUT_LENS):
        try:
            return lens_of(message.content, where, rectified=topics.rectified)
        except FileError as found:
            error = error or found
    raise error or FileError(where, "has no message")


def _shared_frames(cameras: Mapping[str, BagCamera]) -> dict[str, list[str]]:
    """The cameras by the frame that they name, if several name one and no baseline parts them."""
    named: dict[str, list[str]] = {}
    for name, camera in cameras.items():
        if not camera.with_baseline:
            named.setdefault(camera.stated.frame, []).append(name)
    return {frame: names for frame, names in named.items() if names[1:]}


def _relative_poses(
    cameras: dict[str, Camera], sigmas: tuple[float, float] | None
) -> tuple[RelativePose, ...]:
    """Each camera's pose in the first: the tree holds no more than these."""
    if sigmas is None:
        return ()
    first = next(iter(cameras))
    return tuple(
        RelativePose(
            a=first,
            b=name,
            T_a_b=relative_transform(cameras[first].T_camera_lidar, camera.T_camera_lidar),
            rotation_sigma_rad=sigmas[0],
            translation_sigma_m=sigmas[1],
        )
        for name, camera in cameras.items()
        if name != first
    )
