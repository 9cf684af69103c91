"""Frames in their parents, as in TF and URDF: where the cameras are, seen from the LiDAR."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.formats.part import IMU, FrameLink
from calibgraph.io.formats.rig_export import frame_id
from calibgraph.model.geometry import T_OPTICAL_LINK, invert

_LIDAR_WORDS = (
    "lidar", "velodyne", "ouster", "os_sensor", "hesai", "pandar", "livox", "rslidar", "robosense",
)  # fmt: skip
_CAMERA_FRAMES = (
    "{}_optical_frame", "{}_optical_link", "{}_optical", "{}/camera_optical_link",
    "{}_camera_optical_frame", "{}_color_optical_frame", "{}/camera_link", "{}_camera_link",
    "{}_link", "{}",
)  # fmt: skip
"""Frames of a camera, by its name; those that are not optical are x forward, y left, z up."""


class FrameTree:
    """Frames with the pose of each in its root.

    Raises:
        CalibrationError: if a frame has two parents, or is its own ancestor.
    """

    def __init__(self, links: Iterable[FrameLink]) -> None:
        self._links: dict[str, FrameLink] = {}
        for link in links:
            if link.child in self._links:
                raise CalibrationError(f"frame {link.child!r} has two parents; give one of them")
            self._links[link.child] = link
        parents = {link.parent for link in self._links.values()}
        self.names = tuple(sorted(parents | self._links.keys()))

    def T_camera_lidar(self, camera_frame: str, lidar_frame: str) -> Array:
        """(4, 4) from the LiDAR frame to the optical axes of a camera's frame.

        Raises:
            CalibrationError: if a frame is unknown, or the two are not connected.
        """
        camera_root, T_root_frame = self._in_root(camera_frame)
        lidar_root, T_root_lidar = self._in_root(lidar_frame)
        if camera_root != lidar_root:
            raise CalibrationError(
                f"frames {camera_frame!r} and {lidar_frame!r} are not connected: their roots are "
                f"{camera_root!r} and {lidar_root!r}; add the file with the transform between them"
            )
        T_frame_lidar: Array = invert(T_root_frame) @ T_root_lidar
        return T_frame_lidar if is_optical(camera_frame) else T_OPTICAL_LINK @ T_frame_lidar

    def _in_root(self, frame: str) -> tuple[str, Array]:
        if frame not in self.names:
            raise CalibrationError(f"no frame {frame!r}; there are {', '.join(self.names)}")
        T, passed = np.eye(4), {frame}
        while frame in self._links:
            link = self._links[frame]
            T, frame = link.T_parent_child @ T, link.parent
            if frame in passed:
                raise CalibrationError(f"frame {frame!r} is its own ancestor; correct the file")
            passed.add(frame)
        return frame, T


def is_optical(frame: str) -> bool:
    """Whether a frame is x right, y down, z forward, by its name."""
    return "optical" in frame.lower()


def find_lidar_frame(tree: FrameTree) -> str:
    """The one frame with the name of a LiDAR."""
    found = [name for name in tree.names if any(word in name.lower() for word in _LIDAR_WORDS)]
    if len(found) != 1:
        what = f"could be {', '.join(found)}" if found else f"is none of {', '.join(tree.names)}"
        raise CalibrationError(f"the frame of the LiDAR {what} by name; name it with --lidar-frame")
    return found[0]


def find_camera_frame(tree: FrameTree, camera: str, chosen: Mapping[str, str]) -> str | None:
    """The chosen frame of a camera, else one with its name; None if there is none."""
    if camera in chosen:
        return chosen[camera]
    names = (pattern.format(frame_id(camera)) for pattern in _CAMERA_FRAMES)
    return next((name for name in names if name in tree.names), None)


NO_LIDAR_IN_IMU = (
    "poses of cameras in the IMU are not used, as no file has the LiDAR in the IMU (extrinsic_R, "
    "extrinsic_T); write --lidar-frame imu if the two frames are one"
)


def tied_links(links: Sequence[FrameLink], lidar_frame: str | None) -> Sequence[FrameLink]:
    """The links without cameras in an IMU that nothing ties to other frames."""
    others = [each for each in links if each.child == IMU or
              (each.parent == IMU and not is_optical(each.child))]  # fmt: skip
    if others or lidar_frame == IMU:
        return links
    return [each for each in links if each.parent != IMU]
