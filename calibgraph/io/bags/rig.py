"""The rig of a bag: lenses from camera_info, the guess from tf_static."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import DatasetError
from calibgraph.files import checked_model
from calibgraph.io.bags.camera_info import CameraLens, lens_of
from calibgraph.io.bags.messages import Bag
from calibgraph.io.bags.options import BagOptions
from calibgraph.io.bags.topics import CameraTopics, choose_topics
from calibgraph.io.bags.transforms import Tree, static_tree, transform_between
from calibgraph.model.geometry import relative_transform
from calibgraph.model.rig import Camera, RelativePose, Rig

Array = NDArray[np.float64]

_UPWARD = 0.9
"""Vertical part of a camera's axis (64 deg), beyond which it looks up: z is up in body axes."""


@dataclass(frozen=True, eq=False)
class BagCamera:
    """A camera of a bag.

    Attributes:
        lens: from its CameraInfo.
        T_camera_lidar: (4, 4); None if /tf_static does not connect it with the LiDAR.
        where: its CameraInfo, for errors.
    """

    lens: CameraLens
    T_camera_lidar: Array | None
    where: str


@dataclass(frozen=True, eq=False)
class BagRig:
    """The LiDAR's frame, the cameras by name, and all frames of /tf_static."""

    lidar: str
    cameras: Mapping[str, BagCamera]
    frames: tuple[str, ...]


def read_bag_rig(path: Path, options: BagOptions | None = None) -> BagRig:
    """What a bag holds about its rig; extrinsics may be missing.

    Args:
        path: the bag.
        options: which topics; those found by type if None.

    Raises:
        FileError, DatasetError: if the bag is damaged, or a topic or a lens is missing.
    """
    bag = Bag(path)
    chosen = choose_topics(bag, (options or BagOptions()).topics)
    lidar = bag.first(chosen.lidar).header.frame_id.lstrip("/")
    tree = static_tree(bag)
    cameras = {
        name: _read_camera(bag, name, topics, tree, lidar)
        for name, topics in chosen.cameras.items()
    }
    return BagRig(lidar, cameras, tuple(sorted(tree)))


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
    read = read_bag_rig(Path(path), options)
    cameras = {
        name: checked_model(Camera, _content(name, camera, read), camera.where)
        for name, camera in read.cameras.items()
    }
    content = {
        "lidar": read.lidar,
        "cameras": cameras,
        "relative_poses": _relative_poses(cameras, relative_sigmas),
    }
    return checked_model(Rig, content, path)


def doubtful_axes(rig: Rig) -> list[str]:
    """A line for each camera that looks straight up, as with body axes for optical ones."""
    return [
        f"{name} looks straight up: is the frame of its camera_info optical, z ahead and y down?"
        for name, T_camera_lidar in rig.T_camera_lidar.items()
        if T_camera_lidar[2, 2] > _UPWARD
    ]


def _read_camera(bag: Bag, name: str, topics: CameraTopics, tree: Tree, lidar: str) -> BagCamera:
    if topics.info is None:
        raise DatasetError(
            f"{bag.path}: {topics.image} has no camera_info beside it; give a rig with the lens of "
            f"camera {name!r} (--rig)",
            camera=name,
        )
    where = f"{bag.path}: {topics.info}"
    lens = lens_of(bag.first(topics.info), where, rectified=topics.rectified)
    T_frame_lidar = transform_between(tree, lens.frame, lidar)
    T_image_frame = np.eye(4)
    T_image_frame[:3, :3] = lens.R_image_frame
    T_camera_lidar = None if T_frame_lidar is None else T_image_frame @ T_frame_lidar
    return BagCamera(lens, T_camera_lidar, where)


def _content(name: str, camera: BagCamera, read: BagRig) -> dict[str, Any]:
    """The fields of a Camera.

    Raises:
        DatasetError: if the extrinsic is missing.
    """
    if camera.T_camera_lidar is None:
        raise DatasetError(
            f"{camera.where}: /tf_static does not connect the LiDAR's frame {read.lidar!r} with "
            f"the frame {camera.lens.frame!r} of camera {name!r}; its frames are "
            f"{', '.join(read.frames) or 'none'}: describe its mounting to calibgraph guess, give "
            "a rig with the guess (--rig), or import the bag together with a URDF",
            camera=name,
        )
    return {**camera.lens.content, "T_camera_lidar": camera.T_camera_lidar}


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
