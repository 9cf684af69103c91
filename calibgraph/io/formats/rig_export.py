"""A rig as the exporters take it: frames by name, covariances, and the statement of direction.

Lenses that a format cannot carry are refused, not rounded.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.model.calibration import FRAMES_SENTENCE, Calibration
from calibgraph.model.geometry import invert, point_in_lidar, ros_pose_covariance
from calibgraph.model.rig import Camera, Mount, Rig
from calibgraph.model.verdict import rig_verdict

EXPORT_MARK = "calibgraph export"
CAMERA_FRAME = "{camera}_optical_frame"
AXES_SENTENCE = "camera axes are optical: x right, y down, z forward; metres and radians"
COVARIANCE_SENTENCE = (
    "covariance: of the camera's pose in the LiDAR frame, row-major 6x6 in the order of ROS: "
    "x y z [m], then rotation about the fixed LiDAR axes x y z [rad]"
)
_WORKED_CAMERA_M = np.array([1.0, 2.0, 10.0])  # right, below and ahead, so that no sign is free


@dataclass(frozen=True, eq=False)
class RigExport:
    """A rig to be written in the format of another program.

    Attributes:
        rig: its cameras are those that are written.
        covariance: per camera whose error bar holds, (6, 6) as of a result, rotation first.
        verdict: PASS, WARN or FAIL; empty for a rig file.
        lidar_frame: the LiDAR's frame id.
        optical_frames: per camera, the id of its optical frame.
        in_tree: whether the frames are those of the rig, and of the robot's tree that it knows.
        T_base_lidar: (4, 4) where the LiDAR is mounted on the vehicle or sensor kit, if given.
    """

    rig: Rig
    covariance: Mapping[str, Array]
    verdict: str
    lidar_frame: str
    optical_frames: Mapping[str, str]
    T_base_lidar: Array | None = None
    in_tree: bool = True

    def link(self, name: str) -> tuple[str, str, Array]:
        """Parent, child and (4, 4) T_parent_child of the transform that a calibration changes."""
        mount, T_lidar_camera = self.mount(name), self.T_lidar_camera(name)
        if mount is None:
            return self.lidar_frame, self.optical_frames[name], T_lidar_camera
        return mount.parent, mount.child, mount.T_parent_child(T_lidar_camera)

    def mount(self, name: str) -> Mount | None:
        """The link of the robot's tree by which a camera hangs, if frames are the tree's."""
        return self.cameras[name].mount if self.in_tree else None

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name."""
        return self.rig.cameras

    def T_lidar_camera(self, name: str) -> Array:
        """(4, 4) the pose of a camera in the LiDAR frame."""
        return invert(self.cameras[name].T_camera_lidar)

    def ros_covariance(self, name: str) -> Array | None:
        """(6, 6) of the pose in the LiDAR frame, in the order of ROS; None without error bar."""
        if name not in self.covariance:
            return None
        return ros_pose_covariance(self.covariance[name], self.cameras[name].T_camera_lidar)

    @property
    def origin(self) -> str:
        """The first line of a comment: the mark of exports, and the verdict."""
        verdict = f"verdict {self.verdict}" if self.verdict else "a rig file, without verdict"
        return f"{EXPORT_MARK}; {verdict}"

    def statement(self, *direction: str) -> list[str]:
        """Lines for a comment: origin, direction, and a worked point of each camera."""
        frames = ", ".join(f"{name}: {frame}" for name, frame in self.optical_frames.items())
        lines = [
            self.origin,
            *direction,
            f"LiDAR frame: {self.lidar_frame}; optical frames: {frames}",
            AXES_SENTENCE,
            f"worked points, by {FRAMES_SENTENCE}",
            *(self._worked_point(name) for name in self.cameras),
        ]
        return [" ".join(line.split()) for line in lines]

    def _worked_point(self, name: str) -> str:
        T = self.cameras[name].T_camera_lidar
        p_lidar = point_in_lidar(T, _WORKED_CAMERA_M).round(3)
        p_camera = T[:3, :3] @ p_lidar + T[:3, 3]
        return (
            f"{name}: p_lidar = ({_triple(p_lidar, 3)}) m -> p_camera = ({_triple(p_camera, 6)}) m"
        )


def _triple(values: Array, digits: int) -> str:
    return ", ".join(f"{value + 0.0:.{digits}f}" for value in values)


def prepare_export(
    source: Rig | Calibration,
    *,
    cameras: Iterable[str] | None,
    lidar_frame: str | None,
    camera_frame: str | None,
    T_base_lidar: Array | None,
) -> RigExport:
    """Collect what exporters need; arguments as of :func:`calibgraph.export_calibration`.

    Raises:
        ValueError: if a camera is unknown, or two frames have one name.
    """
    result = source if isinstance(source, Calibration) else None
    rig = source.rig if isinstance(source, Calibration) else source
    names = list(rig.cameras if cameras is None else cameras)
    for name in names:
        if name not in rig.cameras:
            raise ValueError(f"camera {name!r}: the rig has {', '.join(rig.cameras)}")
    frames = {
        name: frame_id(_camera_frame(rig.cameras[name], camera_frame).replace("{camera}", name))
        for name in names
    }
    lidar = frame_id(rig.lidar if lidar_frame is None else lidar_frame)
    if len({lidar, *frames.values()} - {""}) <= len(frames):
        raise ValueError(
            f"frames {[lidar, *frames.values()]}: two are the same, or one is empty; "
            "--camera-frame holds {camera}"
        )
    return RigExport(
        rig=rig.model_copy(update={"cameras": {name: rig.cameras[name] for name in names}}),
        covariance=_covariances(result, names),
        verdict="" if result is None else _verdict(result, names),
        lidar_frame=lidar,
        optical_frames=frames,
        T_base_lidar=T_base_lidar,
        in_tree=lidar_frame is None and camera_frame is None,
    )


def _camera_frame(camera: Camera, given: str | None) -> str:
    """The given frame, else the rig's, else one by the camera's name."""
    return (camera.frame_id or CAMERA_FRAME) if given is None else given


def frame_id(name: str) -> str:
    """A name as ROS frame id: other characters than letters, digits, _ / . - become _."""
    return re.sub(r"[^\w/.-]", "_", name)


def _verdict(result: Calibration, names: Iterable[str]) -> str:
    """The worst of the cameras that are written."""
    return rig_verdict({name: result.camera_verdicts[name] for name in names}).status


def _covariances(result: Calibration | None, names: Iterable[str]) -> dict[str, Array]:
    """The covariances of the cameras whose error bar holds."""
    if result is None:
        return {}
    found = {name: result.covariance.get(name) for name in names if result.error_bar_holds(name)}
    return {name: covariance for name, covariance in found.items() if covariance is not None}


def carried_coefficients(name: str, camera: Camera, most: int, what: str) -> list[float]:
    """A pinhole's coefficients, ``most`` of them, in OpenCV's order."""
    padded = [*camera.distortion, *[0.0] * most]
    if any(padded[most:]):
        raise CalibrationError(
            f"camera {name!r}: {what} holds {most or 'no'} distortion coefficients, this lens has "
            f"{camera.distortion}; choose another --format (opencv, json)",
            camera=name,
        )
    return padded[:most]


def no_place_for(name: str, camera: Camera, what: str) -> CalibrationError:
    """The error of a format that has no place for a camera's lens model."""
    return CalibrationError(
        f"camera {name!r}: {what} cannot hold a lens of the model {camera.model}; choose another "
        "--format (opencv, json), or undistort the images and calibrate these",
        camera=name,
    )
