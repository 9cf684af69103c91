"""An MCAP file of a result for Foxglove, with Foxglove's own message types."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.errors import needs_extra
from calibgraph.files import write_atomically
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera, Rig
from calibgraph.outputs import VIEW_MARK
from calibgraph.progress import Progress, no_progress
from calibgraph.view.scene import Projected, ViewFrame, read_frames, state_verdict

LIDAR_FRAME = "lidar"
_DISTORTIONS = {"fisheye": "kannala_brandt"}
_RATIONAL = 8  # coefficients
_DOT_PX = 3.0
_LEVELS = {"PASS": "INFO", "WARN": "WARNING", "FAIL": "ERROR"}


def write_mcap(result: Calibration, path: Path | str, *, progress: Progress = no_progress) -> Path:
    """Write clouds, images, projected points and frames of a result, a second per frame.

    Topics: ``/lidar`` (PointCloud), ``/tf`` (FrameTransforms: the pose of CAMERA_optical_frame, and
    of CAMERA_before, in ``lidar``), ``/CAMERA/image`` (CompressedImage), ``/CAMERA/calibration``
    (CameraCalibration, of lenses that Foxglove has), ``/CAMERA/before`` and ``/CAMERA/after``
    (ImageAnnotations), ``/verdict`` (Log).

    Raises:
        CalibrationError: if mcap is missing, or an image or cloud cannot be read.
    """
    messages = _Messages()
    path = Path(path)

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            writer = messages.writer(file)
            for done, frame in enumerate(read_frames(result)):
                progress(f"frame {frame.name}", done, len(result.frames))
                for topic, message in messages.of_frame(frame, result):
                    stamp = _nanoseconds(frame)
                    writer.write_message(topic, message, log_time=stamp, publish_time=stamp)
            writer.finish()

    write_atomically(path, write)
    return path


def _nanoseconds(frame: ViewFrame) -> int:
    return round(frame.time_s * 1e9)


class _Messages:
    """Foxglove's messages, imported when they are needed.

    Raises:
        CalibrationError: if they are not installed.
    """

    def __init__(self) -> None:
        with needs_extra(
            "view", "--mcap needs mcap-protobuf-support and foxglove-schemas-protobuf"
        ):
            from foxglove_schemas_protobuf import (
                CameraCalibration_pb2,
                CompressedImage_pb2,
                FrameTransforms_pb2,
                ImageAnnotations_pb2,
                Log_pb2,
                PackedElementField_pb2,
                PointCloud_pb2,
                PointsAnnotation_pb2,
            )
            from mcap_protobuf.writer import Writer
        self._Writer = Writer
        self._Cloud: Any = PointCloud_pb2.PointCloud
        self._Image: Any = CompressedImage_pb2.CompressedImage
        self._Lens: Any = CameraCalibration_pb2.CameraCalibration
        self._Transforms: Any = FrameTransforms_pb2.FrameTransforms
        self._Annotations: Any = ImageAnnotations_pb2.ImageAnnotations
        self._Points: Any = PointsAnnotation_pb2.PointsAnnotation
        self._Field: Any = PackedElementField_pb2.PackedElementField
        self._Log: Any = Log_pb2.Log

    def writer(self, file: Any) -> Any:
        """A writer into an open file."""
        return self._Writer(file, profile=VIEW_MARK)

    def of_frame(self, frame: ViewFrame, result: Calibration) -> list[tuple[str, Any]]:
        """The topics and messages of a frame, stamped."""
        found = [("/tf", self._transforms(result)), ("/lidar", self._cloud(frame))]
        found.append(("/verdict", self._verdict(result)))
        for name, image in frame.images.items():
            camera = result.rig.cameras[name]
            found.append((f"/{name}/image", self._image(name, image.jpeg)))
            found += [(f"/{name}/calibration", m) for m in self._lenses(name, camera)]
            for when, points in (("before", image.before), ("after", image.after)):
                found.append((f"/{name}/{when}", self._annotations(points, frame)))
        for _, message in found:
            _stamp(message, frame)
        return found

    def _cloud(self, frame: ViewFrame) -> Any:
        message = self._Cloud(frame_id=LIDAR_FRAME)
        message.pose.orientation.w = 1.0
        packed = np.empty(len(frame.points_lidar_m), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
        packed["xyz"], packed["rgba"][:, :3] = frame.points_lidar_m, frame.colours
        packed["rgba"][:, 3] = 255
        message.point_stride, message.data = packed.dtype.itemsize, packed.tobytes()
        numbers = (("x", 0, 4), ("y", 4, 4), ("z", 8, 4))
        colours = (("red", 12, 1), ("green", 13, 1), ("blue", 14, 1), ("alpha", 15, 1))
        kinds = {4: self._Field.FLOAT32, 1: self._Field.UINT8}
        for name, offset, size in (*numbers, *colours):
            message.fields.add(name=name, offset=offset, type=kinds[size])
        return message

    def _transforms(self, result: Calibration) -> Any:
        message = self._Transforms()
        for rig, suffix in ((result.rig, "optical_frame"), (result.initial_rig, "before")):
            self._add_poses(message, rig, suffix)
        return message

    def _add_poses(self, message: Any, rig: Rig, suffix: str) -> None:
        for name, T_camera_lidar in rig.T_camera_lidar.items():
            T = invert(T_camera_lidar)
            one = message.transforms.add(
                parent_frame_id=LIDAR_FRAME, child_frame_id=f"{name}_{suffix}"
            )
            one.translation.x, one.translation.y, one.translation.z = T[:3, 3].tolist()
            x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
            one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w = x, y, z, w

    def _image(self, name: str, jpeg: bytes) -> Any:
        return self._Image(frame_id=f"{name}_optical_frame", format="jpeg", data=jpeg)

    def _lenses(self, name: str, camera: Camera) -> list[Any]:
        """The lens, if Foxglove has it."""
        if camera.model not in ("pinhole", "fisheye"):
            return []
        rational = len(camera.distortion) == _RATIONAL
        K = camera.matrix_px
        pinhole = "rational_polynomial" if rational else "plumb_bob"
        return [
            self._Lens(
                frame_id=f"{name}_optical_frame",
                width=camera.width_px,
                height=camera.height_px,
                distortion_model=_DISTORTIONS.get(camera.model, pinhole),
                D=[*camera.distortion] or [0.0] * 5,
                K=K.ravel().tolist(),
                R=np.eye(3).ravel().tolist(),
                P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
            )
        ]

    def _annotations(self, points: Projected, frame: ViewFrame) -> Any:
        message = self._Annotations()
        one = message.points.add(type=self._Points.POINTS, thickness=_DOT_PX)
        _stamp(one, frame)
        for u, v in points.pixels_px.tolist():
            one.points.add(x=u, y=v)
        for red, green, blue in (points.colours / 255.0).tolist():
            one.outline_colors.add(r=red, g=green, b=blue, a=1.0)
        return message

    def _verdict(self, result: Calibration) -> Any:
        level = getattr(self._Log, _LEVELS[result.verdict.status])
        return self._Log(level=level, message=state_verdict(result), name="calibgraph")


def _stamp(message: Any, frame: ViewFrame) -> None:
    """Set the time of a message, and of the transforms in it."""
    for one in getattr(message, "transforms", [message]):
        if hasattr(one, "timestamp"):
            one.timestamp.FromNanoseconds(_nanoseconds(frame))
