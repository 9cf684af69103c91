"""The rig of a bag: lenses from camera_info, the guess from tf_static."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibgraph.errors import DatasetError
from calibgraph.files import checked_model
from calibgraph.io.bags.camera_info import lens_of
from calibgraph.io.bags.messages import Bag
from calibgraph.io.bags.options import BagOptions
from calibgraph.io.bags.topics import CameraTopics, choose_topics
from calibgraph.io.bags.transforms import Tree, static_tree, transform_between
from calibgraph.model.geometry import camera_center, relative_transform
from calibgraph.model.rig import Camera, RelativePose, Rig

_STEEP_DEG = 60
"""A camera's body axes, taken for its optical ones, look straight up: z is up in them."""


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
    bag = Bag(Path(path))
    chosen = choose_topics(bag, (options or BagOptions()).topics)
    lidar = bag.first(chosen.lidar).header.frame_id.lstrip("/")
    tree = static_tree(bag)
    cameras = {
        name: _camera(bag, name, topics, tree, lidar) for name, topics in chosen.cameras.items()
    }
    content = {
        "lidar": lidar,
        "cameras": cameras,
        "relative_poses": _relative_poses(cameras, relative_sigmas),
    }
    return checked_model(Rig, content, path)


def describe_rig(rig: Rig) -> list[str]:
    """A sentence per camera: where it sits, and where it looks, as +x of the LiDAR is ahead."""
    return [_describe(name, camera) for name, camera in rig.cameras.items()]


def _describe(name: str, camera: Camera) -> str:
    x, y, z = camera_center(camera.T_camera_lidar)
    ahead, left, up = camera.T_camera_lidar[2, :3]
    yaw, pitch = np.degrees([np.arctan2(left, ahead), np.arctan2(up, np.hypot(ahead, left))])
    across = f"{abs(yaw):.0f} deg {'left' if yaw > 0 else 'right'} of +x"
    upward = f"{abs(pitch):.0f} deg {'up' if pitch > 0 else 'down'}"
    if abs(pitch) > _STEEP_DEG:
        upward += " (are these the optical axes, z ahead and y down?)"
    return (
        f"{name}: {camera.model}, {camera.width_px}x{camera.height_px} px; in the LiDAR's frame at "
        f"x {x:.2f} y {y:.2f} z {z:.2f} m, looks {across} and {upward}"
    )


def _camera(bag: Bag, name: str, topics: CameraTopics, tree: Tree, lidar: str) -> Camera:
    if topics.info is None:
        raise DatasetError(
            f"{bag.path}: {topics.image} has no camera_info beside it; give a rig with the lens of "
            f"camera {name!r} (--rig)",
            camera=name,
        )
    where = f"{bag.path}: {topics.info}"
    lens = lens_of(bag.first(topics.info), where, rectified=topics.rectified)
    T_frame_lidar = transform_between(tree, lens.frame, lidar)
    if T_frame_lidar is None:
        frames = ", ".join(sorted(tree)) or "none"
        raise DatasetError(
            f"{bag.path}: /tf_static does not connect the LiDAR's frame {lidar!r} with the frame "
            f"{lens.frame!r} of camera {name!r}; its frames are {frames}: give a rig with the "
            "guess (--rig)",
            camera=name,
        )
    T_image_frame = np.eye(4)
    T_image_frame[:3, :3] = lens.R_image_frame
    content = {**lens.content, "T_camera_lidar": T_image_frame @ T_frame_lidar}
    return checked_model(Camera, content, where)


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
