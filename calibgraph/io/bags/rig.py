"""The rig of a bag: lenses from camera_info, the guess from tf_static."""

from collections import Counter
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from shlex import quote

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError, FileError
from calibgraph.io.bags.camera_info import StatedLens, lens_of, stated_baseline
from calibgraph.io.bags.messages import CAMERA_INFO, Bag, open_drive
from calibgraph.io.bags.storage import BagOptions
from calibgraph.io.bags.topics import RigTopics, choose_topics, is_rectified
from calibgraph.io.bags.transforms import Transforms
from calibgraph.io.lenses import CameraLens
from calibgraph.io.rig_parts import RigParts, find_mounts
from calibgraph.model.geometry import angle_deg
from calibgraph.model.rig import Rig

_UPWARD = 0.9
"""Vertical part of a camera's axis (64 deg), beyond which it looks up: z is up in body axes."""
_MOST_WITHOUT_LENS = 100  # messages at the start, each of which may be in a chunk of its own
_LEAST_BASELINE_M = 1e-3
_AT_ONE_PLACE = 0.05
"""Of a stated baseline: frames of /tf_static that are nearer to each other leave it out."""


def read_bag_rig(path: Path, options: BagOptions | None = None) -> RigParts:
    """What a bag holds about its rig; extrinsics may be missing."""
    options = options or BagOptions()
    bag = Bag(path)
    drive = open_drive(bag, options.beside)
    chosen = choose_topics(bag, options.topics, drive=drive)
    lidar = bag.first(chosen.lidar).header.frame_id.lstrip("/")
    reader = _CameraReader(drive, lidar)
    for name in chosen.images:
        reader.read(name, chosen)
    counts = Counter([lidar, *reader.frame_ids.values()])
    shared = {frame: names for frame, names in reader.by_frame.items() if names[1:]}
    both = [f"{' and '.join(names)} name one frame, {frame!r}" for frame, names in shared.items()]
    notes = [*chosen.notes, *reader.transforms.notes, *reader.notes]
    return RigParts(
        path,
        reader.lenses,
        reader.T_camera_lidar,
        frame_ids={name: frame for name, frame in reader.frame_ids.items() if counts[frame] == 1},
        mounts=find_mounts(reader.hanging, lidar, reader.transforms.links),
        lidar=lidar,
        notes=(*notes, *(f"{path}: {each}: at most one of them is there" for each in both)),
        why_missing=reader.why_missing,
    )


def doubtful_axes(rig: Rig) -> list[str]:
    """A line for each camera that looks straight up, as with body axes for optical ones."""
    return [
        f"{name} looks straight up: is the frame of its camera_info optical, z ahead and y down?"
        for name, T_camera_lidar in rig.T_camera_lidar.items()
        if T_camera_lidar[2, 2] > _UPWARD
    ]


class _CameraReader:
    """Reads the cameras of a bag of a drive: what a rig has of them, by name.

    Attributes:
        frame_ids: of an image whose frame has its axes and origin.
        hanging: the frame in the tree, and (4, 4) from it to the image.
        by_frame: the cameras that name a frame, where no baseline parts them.
    """

    def __init__(self, drive: Sequence[Bag], lidar: str) -> None:
        self._drive, self._lidar = drive, lidar
        self.transforms = Transforms(drive)
        self.notes: list[str] = []
        self.lenses: dict[str, CameraLens] = {}
        self.T_camera_lidar: dict[str, Array] = {}
        self.frame_ids: dict[str, str] = {}
        self.hanging: dict[str, tuple[str, Array]] = {}
        self.by_frame: dict[str, list[str]] = {}
        self.why_missing: dict[str, str] = {}

    def read(self, name: str, topics: RigTopics) -> None:
        """Read a camera; its extrinsic may be missing."""
        if name in topics.unclear:
            raise DatasetError(
                f"{self._drive[0].path}: {topics.unclear[name]}, or calibrate "
                f"with a rig that has the lens of camera {name!r} (--rig)",
                camera=name,
            )
        info = topics.infos[name]
        bag = next(bag for bag in self._drive if bag.has(info))
        if bag is not self._drive[0]:
            self.notes.append(f"{self._drive[0].path}: {info} is that of {bag.path}")
        where = f"{bag.path}: {info}"
        lens = _first_lens(bag, info, where, rectified=is_rectified(topics.images[name]))
        with_baseline = self._counts_baseline(name, lens, bag, info)
        self.lenses[name] = lens.lens
        if not with_baseline:
            self.by_frame.setdefault(lens.frame, []).append(name)
        if lens.is_turned and not with_baseline:
            self.notes.append(
                f"{name}: its images are rectified, and turned by "
                f"{angle_deg(lens.R_image_frame):.2g} deg against frame {lens.frame!r}; an export "
                "has a frame of their own"
            )
        elif lens.frame and not with_baseline:
            self.frame_ids[name] = lens.frame
        T_frame_lidar = self.transforms.between(lens.frame, self._lidar)
        if T_frame_lidar is None:
            self.why_missing[name] = (
                f"{where}: no static transforms connect the LiDAR's frame {self._lidar!r} "
                f"with the frame {lens.frame!r} of camera {name!r}: "
                f"{self.transforms.why_apart(lens.frame, self._lidar)}. If another bag of the "
                "drive has them, give it too; else describe the mounting with calibgraph rig BAG "
                f"--mount {quote(name)}=WORDS --out rig.yaml, or add a URDF: calibgraph rig BAG "
                "car.urdf --out rig.yaml; then calibrate with --rig rig.yaml"
            )
        else:
            T_image_frame = lens.T_image_frame(with_baseline=with_baseline)
            self.hanging[name] = lens.frame, T_image_frame
            self.T_camera_lidar[name] = T_image_frame @ T_frame_lidar

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


def _first_lens(bag: Bag, info: str, where: str, *, rectified: bool) -> StatedLens:
    """The lens of the first CameraInfo that has one: some drivers begin with zeros."""
    error: FileError | None = None
    for message in islice(bag.messages([info]), _MOST_WITHOUT_LENS):
        try:
            return lens_of(message.content, where, rectified=rectified)
        except FileError as found:
            error = error or found
    raise error or FileError(where, "has no message")
