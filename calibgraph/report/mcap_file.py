"""An MCAP file of a result for Foxglove, with Foxglove's own message types. Rerun opens it, too."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, needs_extra
from calibgraph.files import write_atomically
from calibgraph.io.frame import Frame, frame_of_entry
from calibgraph.io.rig_parts import quaternion_xyzw
from calibgraph.model.calibration import Calibration
from calibgraph.model.clock import when_taken
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera
from calibgraph.progress import Progress, no_progress
from calibgraph.report.page_overlays import Image, depth_colours, visible_points

with needs_extra("view", "--mcap needs foxglove-sdk"):
    import foxglove
    from foxglove import channels
    from foxglove import messages as m

SECONDS_PER_FRAME = 1
"""Results have no stamps: frames are shown one after another."""

LIDAR_FRAME = "lidar"
_DISTORTIONS = {"fisheye": "kannala_brandt"}
_RATIONAL = 8  # coefficients
_DOT_PX = 3.0
_MAX_POINTS = 20_000  # on an image: viewers draw each
_JPEG_QUALITY = 90
_LEVELS = {"PASS": "Info", "WARN": "Warning", "FAIL": "Error"}
_XYZ_RGBA = np.dtype([("xyz", "<f4", 3), ("rgba", "u1", 4)])


def write_mcap(result: Calibration, path: Path | str, *, progress: Progress = no_progress) -> Path:
    """Write clouds, images, projected points and frames of a result, a second per frame.

    Topics: ``/lidar`` (PointCloud), ``/tf`` (FrameTransforms: the pose of CAMERA_optical_frame, and
    of CAMERA_before, in ``lidar``), ``/CAMERA/image`` (CompressedImage), ``/CAMERA/calibration``
    (CameraCalibration, of lenses that Foxglove has), ``/CAMERA/before`` and ``/CAMERA/after``
    (ImageAnnotations), ``/verdict`` (Log).

    Raises:
        CalibrationError: if foxglove-sdk is missing, the result names no frames, or an image or
            cloud cannot be read.
    """
    if not result.frames:
        raise CalibrationError(
            "the result names no images and clouds, as that of a table; give a result that "
            "was made from them"
        )
    path, context, opened = Path(path), foxglove.Context(), dict[str, Any]()

    def write(temporary: Path) -> None:
        options = foxglove.mcap.MCAPWriteOptions(profile="calibgraph")
        with (
            temporary.open("wb") as file,
            foxglove.open_mcap(file, context=context, writer_options=options),
        ):
            for done, entry in enumerate(result.frames):
                progress(f"frame {done}", done, len(result.frames))
                at = m.Timestamp(done * SECONDS_PER_FRAME, 0)
                for topic, message in _messages(frame_of_entry(entry), at, result):
                    if topic not in opened:
                        kind = getattr(channels, f"{type(message).__name__}Channel")
                        opened[topic] = kind(topic, context=context)
                    opened[topic].log(message, log_time=at.sec * 10**9)

    write_atomically(path, write)
    return path


def _messages(frame: Frame, at: m.Timestamp, result: Calibration) -> Iterator[tuple[str, Any]]:
    """The topics and messages of a frame."""
    level = getattr(m.LogLevel, _LEVELS[result.verdict.status])
    text = "\n".join([result.verdict.status, *result.verdict.reasons])
    points = frame.load_cloud()[:, :3]
    points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], np.float32)
    yield "/tf", _transforms(result, at)
    yield "/lidar", _cloud(points, at)
    yield "/verdict", m.Log(timestamp=at, level=level, message=text, name="calibgraph")
    rigs = {"before": result.initial_rig, "after": result.rig}
    for name in filter(frame.image_paths.__contains__, result.rig.cameras):
        camera, optical = result.rig.cameras[name], f"{name}_optical_frame"
        image = frame.load_image(name, camera)
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        jpeg = m.CompressedImage(timestamp=at, frame_id=optical, format="jpeg", data=data.tobytes())
        yield f"/{name}/image", jpeg
        if camera.model in ("pinhole", "fisheye"):  # Foxglove has no others
            yield f"/{name}/calibration", _lens(camera, optical, at)
        for when, rig in rigs.items():
            seen = project_cloud(when_taken(rig.cameras[name], frame.twist_per_s), points)
            yield f"/{name}/{when}", _annotations(*seen, at)


def project_cloud(camera: Camera, points_lidar_m: NDArray[np.float32]) -> tuple[Array, Image]:
    """The points of a cloud (n, 3) on a camera's image, an even choice of very many.

    Returns:
        (k, 2) pixels, and (k, 3) RGB colours by distance, 0 to 255.
    """
    points, pixels = visible_points(points_lidar_m.astype(np.float64), camera)
    step = max(1, -(-len(pixels) // _MAX_POINTS))
    return pixels[::step], _by_distance(points[::step])


def _by_distance(points: NDArray[np.floating]) -> Image:
    return depth_colours(np.asarray(np.linalg.norm(points, axis=1), np.float64))[:, ::-1]


def _cloud(points: NDArray[np.float32], at: m.Timestamp) -> Any:
    packed = np.empty(len(points), _XYZ_RGBA)
    packed["xyz"], packed["rgba"][:, :3] = points, _by_distance(points)
    packed["rgba"][:, 3] = 255
    number, byte = m.PackedElementFieldNumericType.Float32, m.PackedElementFieldNumericType.Uint8
    numbers = [(name, 4 * i, number) for i, name in enumerate("xyz")]
    colours = [(n, 12 + i, byte) for i, n in enumerate(("red", "green", "blue", "alpha"))]
    return m.PointCloud(
        timestamp=at,
        frame_id=LIDAR_FRAME,
        pose=m.Pose(position=m.Vector3(), orientation=m.Quaternion(w=1.0)),
        point_stride=_XYZ_RGBA.itemsize,
        fields=[
            m.PackedElementField(name=name, offset=offset, type=kind)
            for name, offset, kind in (*numbers, *colours)
        ],
        data=packed.tobytes(),
    )


def _transforms(result: Calibration, at: m.Timestamp) -> Any:
    return m.FrameTransforms(
        transforms=[
            m.FrameTransform(
                timestamp=at,
                parent_frame_id=LIDAR_FRAME,
                child_frame_id=f"{name}_{suffix}",
                translation=m.Vector3(**dict(zip("xyz", T[:3, 3].tolist(), strict=True))),
                rotation=m.Quaternion(**dict(zip("xyzw", quaternion_xyzw(T), strict=True))),
            )
            for rig, suffix in ((result.rig, "optical_frame"), (result.initial_rig, "before"))
            for name, T in ((name, invert(T)) for name, T in rig.T_camera_lidar.items())
        ]
    )


def _lens(camera: Camera, frame_id: str, at: m.Timestamp) -> Any:
    K = camera.matrix_px
    rational = len(camera.distortion) == _RATIONAL
    pinhole = "rational_polynomial" if rational else "plumb_bob"
    return m.CameraCalibration(
        timestamp=at,
        frame_id=frame_id,
        width=camera.width_px,
        height=camera.height_px,
        distortion_model=_DISTORTIONS.get(camera.model, pinhole),
        D=[*camera.distortion] or [0.0] * 5,
        K=K.ravel().tolist(),
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([K, np.zeros(3)]).ravel().tolist(),
    )


def _annotations(pixels_px: Array, colours: Image, at: m.Timestamp) -> Any:
    one = m.PointsAnnotation(
        timestamp=at,
        type=m.PointsAnnotationType.Points,
        points=[m.Point2(x=u, y=v) for u, v in pixels_px.tolist()],
        outline_colors=[
            m.Color(r=red, g=green, b=blue, a=1.0)
            for red, green, blue in (colours / 255.0).tolist()
        ],
        thickness=_DOT_PX,
    )
    return m.ImageAnnotations(timestamp=at, points=[one])
