"""What viewers show of a frame: the cloud, the images, and its points on them, before and after."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.frame import frame_of_entry
from calibgraph.model.calibration import Calibration
from calibgraph.model.clock import when_taken
from calibgraph.model.rig import Camera
from calibgraph.report.page_overlays import depth_colours, visible_points

Colours = NDArray[np.uint8]
Projected = tuple[Array, Colours]
"""Points in an image: (n, 2) pixels, and (n, 3) RGB colours by distance."""

_MAX_POINTS = 20_000  # on an image: viewers draw each
_JPEG_QUALITY = 90


@dataclass(frozen=True, eq=False)
class ViewFrame:
    """One frame.

    Attributes:
        number: of the frame in its dataset.
        points_lidar_m: (n, 3) float32 in the LiDAR frame.
        colours: (n, 3) RGB by distance from the LiDAR.
        images: by camera, a JPEG.
        projected: by camera, the points in its image ``before`` and ``after``.
    """

    number: int
    name: str
    points_lidar_m: NDArray[np.float32]
    colours: Colours
    images: Mapping[str, bytes]
    projected: Mapping[str, Mapping[str, Projected]]


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
    rigs = {"before": result.initial_rig, "after": result.rig}
    for frame in map(frame_of_entry, result.frames):
        points = frame.load_cloud()[:, :3]
        points = np.ascontiguousarray(points[np.isfinite(points).all(axis=1)], np.float32)
        images, projected = dict[str, bytes](), dict[str, dict[str, Projected]]()
        for name in filter(frame.image_paths.__contains__, result.rig.cameras):
            image = frame.load_image(name, result.rig.cameras[name])
            _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
            images[name] = data.tobytes()
            projected[name] = {
                when: project_cloud(when_taken(rig.cameras[name], frame.twist_per_s), points)
                for when, rig in rigs.items()
            }
        yield ViewFrame(frame.index, frame.name, points, _by_distance(points), images, projected)


def project_cloud(camera: Camera, points_lidar_m: NDArray[np.float32]) -> Projected:
    """The points of a cloud (n, 3) on a camera's image, an even choice of very many."""
    points, pixels = visible_points(points_lidar_m.astype(np.float64), camera)
    step = max(1, -(-len(pixels) // _MAX_POINTS))
    return pixels[::step], _by_distance(points[::step])


def _by_distance(points: NDArray[np.floating]) -> Colours:
    return np.ascontiguousarray(depth_colours(np.linalg.norm(points, axis=1))[:, ::-1])


def state_verdict(result: Calibration) -> str:
    """The verdict of a result in words, a line per reason."""
    verdict = result.verdict
    return "\n".join([verdict.status, *verdict.reasons])
