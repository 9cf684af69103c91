"""The pictures of pages: a cloud on images, coloured by distance, as data URIs."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.frame import Frame
from calibgraph.model.clock import when_taken
from calibgraph.model.rig import Camera
from calibgraph.report.point_overlay import DEPTH_RANGE_M, depth_colours, draw_points, shrink

_PICTURES_BYTES = 3_000_000  # of all pictures together; base64 adds a third
_SIZES = ((1100, 80), (1100, 70), (960, 65), (800, 60), (640, 60), (480, 50), (320, 40))
_HEIGHT_PX = 640  # at most, so that a picture and its caption fit on a screen
_STOPS = 17  # of the scale's gradient


@dataclass(frozen=True)
class Scale:
    """A gradient of CSS, and its ticks: percent from the left, label."""

    gradient: str
    ticks: tuple[tuple[float, str], ...]


def draw_overlays(
    frame: Frame, cameras: Mapping[str, Sequence[Camera]]
) -> tuple[dict[str, tuple[str, ...]], str | None]:
    """Draw a frame's cloud on the image of each camera, once for each of its extrinsics.

    Returns:
        Per camera its pictures; the reason why the others are missing, None if none are.
    """
    drawn = dict[str, tuple[str, ...]]()
    budget = _PICTURES_BYTES // (2 * len(cameras))
    try:
        cloud = frame.load_cloud()[:, :3].astype(np.float64)
        for name, several in cameras.items():
            if name in frame.image_paths:
                seen = [when_taken(camera, frame.twist_per_s) for camera in several]
                image = frame.load_image(name, several[0])
                drawn[name] = tuple(
                    _to_jpeg(draw_points(image, cloud, camera), budget) for camera in seen
                )
    except (CalibrationError, OSError) as error:
        return drawn, str(error)
    return drawn, None


def width_on_page(camera: Camera) -> int:
    """At most so wide are a camera's pictures shown [px]."""
    return round(_HEIGHT_PX * camera.width_px / camera.height_px)


def depth_scale() -> Scale:
    """The colours of the distances, linear in their logarithm."""
    low, high = np.log(DEPTH_RANGE_M)
    ticks = np.array([2, 5, 10, 20, 50])
    at = 100 * (np.log(ticks) - low) / (high - low)
    stops = depth_colours(np.exp(np.linspace(low, high, _STOPS)))
    labels = [f"{ticks[0]} m", *map(str, ticks[1:])]
    gradient = ", ".join(f"#{r:02x}{g:02x}{b:02x}" for b, g, r in stops.tolist())
    return Scale(gradient, tuple(zip(at.tolist(), labels, strict=True)))


def _to_jpeg(image: NDArray[np.uint8], budget: int) -> str:
    """A data URI of the largest and best JPEG of at most ``budget`` bytes."""
    data = b""
    for width, quality in _SIZES:
        small = shrink(image, width)
        encoded, buffer = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if not encoded:
            raise CalibrationError(f"an image of shape {small.shape} cannot be encoded as JPEG")
        data = buffer.tobytes()
        if len(data) <= budget:
            break
    return f"data:image/jpeg;base64,{base64.b64encode(data).decode('ascii')}"
