"""What viewers show of a frame: the cloud, the images, and its points on them, before and after."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.frame import Frame, frame_of_entry
from calibgraph.model.calibration import Calibration
from calibgraph.model.clock import when_taken
from calibgraph.model.rig import Camera
from calibgraph.report.page_overlays import depth_colours, visible_points

Colours = NDArray[np.uint8]

SECONDS_PER_FRAME = 1.0
"""Results have no stamps: frames are shown one after another."""
_MAX_POINTS = 20_000  # on an image: viewers draw each
_JPEG_QUALITY = 90


@dataclass(frozen=True, eq=False)
class Projected:
    """Points in an image: (n, 2) pixels, and (n, 3) RGB colours by distance."""

    pixels_px: Array
    colours: Colours


@dataclass(frozen=True, eq=False)
class ViewImage:
    """One camera in one frame."""

    jpeg: bytes
    before: Projected
    after: Projected


@dataclass(frozen=True, eq=False)
class ViewFrame:
    """One frame.

    Attributes:
        number: of the frame in its dataset.
        time_s: when it is shown.
        points_lidar_m: (n, 3) float32 in the LiDAR frame.
        colours: (n, 3) RGB by distance from the LiDAR.
        images: by camera.
    """

    number: int
    name: str
    time_s: float
    points_lidar_m: NDArray[np.float32]
    colours: Colours
    images: Mapping[str, ViewImage]


def read_frames(result: Calibration) -> Iterator[ViewFrame]:
    """The frames of a result, one after another, from its clouds and images.

    Raises:
        CalibrationError: if the result names no frames, or a file is missing or damaged.
    """
    if not result.frames:
        raise CalibrationError(
            "the result names no images and clouds, as that of a table; give those that the table "
            "was made from with --dataset"
        )
    for number, frame in enumerate(map(frame_of_entry, result.frames)):
        points = frame.load_cloud()[:, :3]
        points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], np.float32)
        yield ViewFrame(
            number=frame.index,
            name=frame.name,
            time_s=number * SECONDS_PER_FRAME,
            points_lidar_m=points,
            colours=_by_distance(points),
            images={
                name: _view_image(frame, points, name, result)
                for name in frame.image_paths
                if name in result.rig.cameras
            },
        )


def _view_image(
    frame: Frame, points: NDArray[np.float32], name: str, result: Calibration
) -> ViewImage:
    rigs = result.initial_rig, result.rig
    guess, camera = (when_taken(rig.cameras[name], frame.twist_per_s) for rig in rigs)
    image = frame.load_image(name, camera)
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    before = project_cloud(guess, points)
    return ViewImage(data.tobytes(), before, project_cloud(camera, points))


def project_cloud(camera: Camera, points_lidar_m: NDArray[np.float32]) -> Projected:
    """The points of a cloud (n, 3) on a camera's image, an even choice of very many."""
    points, pixels = visible_points(points_lidar_m.astype(np.float64), camera)
    step = max(1, -(-len(pixels) // _MAX_POINTS))
    return Projected(pixels[::step], _by_distance(points[::step]))


def _by_distance(points: NDArray[np.floating]) -> Colours:
    return np.ascontiguousarray(depth_colours(np.linalg.norm(points, axis=1))[:, ::-1])


def state_verdict(result: Calibration) -> str:
    """The verdict of a result in words, a line per reason."""
    verdict = result.verdict
    return "\n".join([verdict.status, *verdict.reasons])
