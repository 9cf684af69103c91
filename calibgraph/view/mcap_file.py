"""An MCAP file of a result for Foxglove, with Foxglove's own message types."""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.errors import needs_extra
from calibgraph.files import write_atomically
from calibgraph.io.rotations import quaternion_xyzw
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera
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
            writer = messages.writer(file, profile=VIEW_MARK)
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
            import foxglove_schemas_protobuf  # noqa: F401
            from mcap_protobuf.writer import Writer
        self.writer: Any = Writer
        self._make = import_module("google.protobuf.json_format").ParseDict

    def _new(self, kind: str, **content: Any) -> Any:
        """A message of a kind, of plain values."""
        schema = import_module(f"foxglove_schemas_protobuf.{kind}_pb2")
        return self._make(content, getattr(schema, kind)())

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
        packed = np.empty(len(frame.points_lidar_m), [("xyz", "<f4", 3), ("rgba", "u1", 4)])
        packed["xyz"], packed["rgba"][:, :3] = frame.points_lidar_m, frame.colours
        packed["rgba"][:, 3] = 255
        numbers = (("x", 0), ("y", 4), ("z", 8))
        colours = (("red", 12), ("green", 13), ("blue", 14), ("alpha", 15))
        message = self._new(
            "PointCloud",
            frame_id=LIDAR_FRAME,
            pose={"orientation": {"w": 1.0}},
            point_stride=packed.dtype.itemsize,
            fields=[{"name": name, "offset": offset, "type": kind}
                    for kind, of in (("FLOAT32", numbers), ("UINT8", colours))
                    for name, offset in of],
        )  # fmt: skip
        message.data = packed.tobytes()
        return message

    def _transforms(self, result: Calibration) -> Any:
        transforms = [
            {
                "parent_frame_id": LIDAR_FRAME,
                "child_frame_id": f"{name}_{suffix}",
                "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
                "rotation": dict(zip("xyzw", quaternion_xyzw(T), strict=True)),
            }
            for rig, suffix in ((result.rig, "optical_frame"), (result.initial_rig, "before"))
            for name, T in ((name, invert(T)) for name, T in rig.T_camera_lidar.items())
        ]
        return self._new("FrameTransforms", transforms=transforms)

    def _image(self, name: str, jpeg: bytes) -> Any:
        message = self._new("CompressedImage", frame_id=f"{name}_optical_frame", format="jpeg")
        message.data = jpeg
        return message

    def _lenses(self, name: str, camera: Camera) -> list[Any]:
        """The lens, if Foxglove has it."""
        if camera.model not in ("pinhole", "fisheye"):
            return []
        rational = len(camera.distortion) == _RATIONAL
        K = camera.matrix_px
        pinhole = "rational_polynomial" if rational else "plumb_bob"
        return [
            self._new(
                "CameraCalibration",
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
        message = self._new("ImageAnnotations", points=[{"type": "POINTS", "thickness": _DOT_PX}])
        one = message.points[0]
        _stamp(one, frame)
        for u, v in points.pixels_px.tolist():
            one.points.add(x=u, y=v)
        for red, green, blue in (points.colours / 255.0).tolist():
            one.outline_colors.add(r=red, g=green, b=blue, a=1.0)
        return message

    def _verdict(self, result: Calibration) -> Any:
        level, text = _LEVELS[result.verdict.status], state_verdict(result)
        return self._new("Log", level=level, message=text, name="calibgraph")


def _stamp(message: Any, frame: ViewFrame) -> None:
    """Set the time of a message, and of the transforms in it."""
    for one in getattr(message, "transforms", [message]):
        if hasattr(one, "timestamp"):
            one.timestamp.FromNanoseconds(_nanoseconds(frame))
