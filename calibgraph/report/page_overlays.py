"""The page's overlays: points on images before and after, coloured by distance and residual."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.frame import load_entry_cloud, twist_of_entry
from calibgraph.io.images import load_image
from calibgraph.model.calibration import Calibration
from calibgraph.model.clock import when_taken
from calibgraph.model.rig import Camera
from calibgraph.report.point_overlay import DEPTH_RANGE_M, depth_colours, draw_points, shrink
from calibgraph.report.reprojection_errors import BeforeAfter, ReprojectionErrors

Image = NDArray[np.uint8]

PICTURES_BYTES = 3_000_000  # of all pictures together; base64 adds a third
_PICTURES = 4  # per camera
_SIZES = ((1100, 80), (1100, 70), (960, 65), (800, 60), (640, 60), (480, 50), (320, 40))
_HEIGHT_PX = 640  # at most, so that a picture and its caption fit on a screen
_DARKENED = 0.45
_MAX_GATES = 2.0  # larger residuals have the last colour
_LEVELS = 24
_STOPS = 17  # of a scale's gradient
_SHIFT = 4  # fractional bits of the coordinates that OpenCV draws


@dataclass(frozen=True)
class Overlays:
    """A camera's pictures of a frame, before and after, as data URIs; None without matches."""

    frame: str
    by_depth: tuple[str, str]
    by_residual: tuple[str, str] | None
    depth_scale: Scale
    residual_scale: Scale | None


@dataclass(frozen=True)
class Scale:
    """A gradient of CSS, and its ticks: percent from the left, label."""

    gradient: str
    ticks: tuple[tuple[float, str], ...]


def draw_overlays(
    result: Calibration, errors: Mapping[str, BeforeAfter]
) -> tuple[dict[str, Overlays], str | None]:
    """Draw all cameras' overlays.

    Args:
        result: names the files of the images and the cloud.
        errors: per camera, for the colours by residual.

    Returns:
        Per camera its pictures; the reason why the others are missing, None if none are.
    """
    if not result.frames:
        return {}, "the result was made from a table, which names no images"
    shown = result.frames[len(result.frames) // 2]
    drawn: dict[str, Overlays] = {}
    try:
        cloud = load_entry_cloud(shown)[:, :3].astype(np.float64)
        for name in result.rig.cameras:
            if name in shown["images"]:
                drawn[name] = _overlays(result, name, shown, cloud, errors=errors.get(name))
    except (CalibrationError, OSError) as error:
        return drawn, str(error)
    return drawn, None


def _overlays(
    result: Calibration,
    name: str,
    shown: Mapping[str, Any],
    cloud: Array,
    *,
    errors: BeforeAfter | None,
) -> Overlays:
    twist = twist_of_entry(shown)
    rigs = result.initial_rig, result.rig
    cameras = [when_taken(rig.cameras[name], twist) for rig in rigs]
    image = load_image(Path(shown["images"][name]), cameras[1])
    budget = PICTURES_BYTES // (_PICTURES * len(result.rig.cameras))
    by_depth = [draw_by_depth(image, cloud, camera, budget) for camera in cameras]
    by_residual = scale = None
    if errors is not None:
        scale = residual_scale(errors.after.gate_px)
        parts = [e.select(e.frame == shown["frame"]) for e in (errors.before, errors.after)]
        before, after = (_by_residual(image, part, budget) for part in parts)
        by_residual = (before, after)
    frame = str(shown["name"])
    return Overlays(frame, (by_depth[0], by_depth[1]), by_residual, depth_scale(), scale)


def draw_by_depth(image: Image, cloud: Array, camera: Camera, budget: int) -> str:
    """A data URI of a cloud on an image, coloured by distance.

    Args:
        image: (height, width, 3) BGR.
        cloud: (n, 3) [m] in the LiDAR frame.
        camera: lens and extrinsic.
        budget: most bytes of the JPEG.
    """
    drawn = shrink(draw_points(image, cloud, camera), _SIZES[0][0])
    return to_jpeg(drawn, budget)


def width_on_page(camera: Camera) -> int:
    """At most so wide are a camera's pictures shown [px]."""
    return round(_HEIGHT_PX * camera.width_px / camera.height_px)


def _by_residual(image: Image, errors: ReprojectionErrors, budget: int) -> str:
    """Projected points on the darkened image, each with a line to its matched pixel."""
    small = shrink(image, _SIZES[0][0])
    factor = small.shape[1] / image.shape[1]
    drawn = np.asarray(small * _DARKENED, dtype=np.uint8)
    ends = np.stack([errors.projected_px, errors.projected_px - errors.vectors_px], axis=1)
    ends = np.clip((ends + 0.5) * factor - 0.5, -1e4, 1e4)
    fixed = np.rint(ends * 2**_SHIFT).astype(np.int32)
    level = _level(errors.sizes_px / errors.gate_px)
    dot = max(3, round(small.shape[1] / 200))
    for number in np.unique(level):
        colour = _LEVEL_COLOURS[number]
        lines = fixed[level == number]
        cv2.polylines(drawn, list(lines), False, colour, 1, cv2.LINE_AA, _SHIFT)
        points = np.repeat(lines[:, :1], 2, axis=1)
        cv2.polylines(drawn, list(points), False, colour, dot, cv2.LINE_AA, _SHIFT)
    return to_jpeg(drawn, budget)


def _level(gates: Array) -> NDArray[np.int64]:
    """(n,) the colour number of residuals in units of the gate."""
    share = np.clip(gates / _MAX_GATES, 0.0, 1.0)
    return np.asarray(np.rint(share * (_LEVELS - 1)), dtype=np.int64)


def _level_colours() -> list[tuple[int, int, int]]:
    """BGR: blue is a small residual, yellow the gate, red beyond it."""
    ramp = np.rint(np.linspace(40, 235, _LEVELS)).astype(np.uint8)
    bgr = cv2.applyColorMap(ramp[:, None], cv2.COLORMAP_TURBO)[:, 0]
    return [(int(b), int(g), int(r)) for b, g, r in bgr]


_LEVEL_COLOURS = _level_colours()


def depth_scale() -> Scale:
    """The colours of the distances, linear in their logarithm."""
    low, high = np.log(DEPTH_RANGE_M)
    ticks = np.array([2, 5, 10, 20, 50])
    at = 100 * (np.log(ticks) - low) / (high - low)
    stops = depth_colours(np.exp(np.linspace(low, high, _STOPS)))
    labels = [f"{ticks[0]} m", *map(str, ticks[1:])]
    return Scale(to_gradient(stops), tuple(zip(at.tolist(), labels, strict=True)))


def residual_scale(gate_px: float) -> Scale:
    """The colours of the residuals, from zero to twice the gate."""
    colours = np.array(_LEVEL_COLOURS, dtype=np.uint8)
    stops = colours[_level(np.linspace(0.0, _MAX_GATES, _STOPS))]
    ticks = ((0.0, "0 px"), (25.0, f"{gate_px / 2:.2g}"), (50.0, f"gate {gate_px:.2g} px"),
             (75.0, f"{1.5 * gate_px:.2g}"))  # fmt: skip
    return Scale(to_gradient(stops), ticks)


def to_gradient(stops: Image) -> str:
    """Colours (n, 3) BGR from left to right, for CSS."""
    return ", ".join(f"#{r:02x}{g:02x}{b:02x}" for b, g, r in stops.tolist())


def to_jpeg(image: Image, budget: int) -> str:
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
