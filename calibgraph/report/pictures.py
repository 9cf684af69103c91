"""Pictures of clouds: on images, coloured by distance; of several LiDARs, from above and aside."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.files import write_bytes
from calibgraph.io.frame import Frame, frame_of_entry
from calibgraph.matching.cloud_similarity import find_upright
from calibgraph.model.calibration import Calibration
from calibgraph.model.clock import when_taken
from calibgraph.model.geometry import move_points
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import Status

Image = NDArray[np.uint8]

DEPTH_RANGE_M, _TICKS_M = (2.0, 60.0), (2, 5, 10, 20, 50)
_MAX_WIDTH_PX = 1280  # of an overlay: a rig of many cameras stays small to send
_BAR_PX = 34
_COVERED_SHARE = 0.2  # of the image, covered by points
_MAX_DOT_PX = 7
_MARKS: dict[Status, str] = {"PASS": "PASS", "WARN": "WARN", "FAIL": "FAIL, do not use"}
_PICTURES_BYTES = 3_000_000  # of all pictures together; base64 adds a third
_SIZES = ((1100, 80), (1100, 70), (960, 65), (800, 60), (640, 60), (480, 50), (320, 40))
_HEIGHT_PX = 640  # at most, so that a picture and its caption fit on a screen
_STOPS = 17  # of the scale's gradient

# RGB colours that the colour-blind can tell apart (Okabe and Ito), the base first; then again.
_COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_REACH_M, _ASIDE_M, _LOW_M, _HIGH_M = 25.0, 2.0, -0.3, 0.5  # of a picture; of its side view
_TOP_PX, _SIDE_PX, _LINE_M, _LINE = (500, 500), (1000, 160), 10.0, (225, 225, 225)


def encode(picture: NDArray[np.uint8], kind: str, *options: int) -> bytes:
    """A picture, BGR, as a file of this kind: png or jpeg."""
    done, data = cv2.imencode(f".{kind}", picture, options)
    if not done:
        raise CalibrationError(f"a picture of shape {picture.shape} cannot be encoded as {kind}")
    return data.tobytes()


def data_uri(data: bytes, kind: str = "png") -> str:
    """The file of a picture as a data URI."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"


def draw_overlays(
    frame: Frame, cameras: Mapping[str, Sequence[Camera]]
) -> tuple[dict[str, tuple[str, ...]], str | None]:
    """Draw a frame's cloud on the image of each camera, once for each of its extrinsics.

    Returns:
        Per camera its pictures; the reason why the others are missing, None if none are.
    """
    drawn = dict[str, tuple[str, ...]]()
    budget = _PICTURES_BYTES // (2 * max(len(cameras), 1))
    try:
        for name, pictures in _draw(frame, cameras):
            drawn[name] = tuple(_to_jpeg(picture, budget) for picture in pictures)
    except (CalibrationError, OSError) as error:
        return drawn, str(error)
    return drawn, None


def _draw(
    frame: Frame, cameras: Mapping[str, Sequence[Camera]]
) -> Iterator[tuple[str, list[Image]]]:
    """The cloud on each camera's image, (height, width, 3) BGR, once for each of its extrinsics."""
    cloud = frame.load_cloud()[:, :3].astype(np.float64)
    for name, several in cameras.items():
        if name in frame.image_paths:
            image = frame.load_image(name, several[0])
            seen = (when_taken(camera, frame.twist_per_s) for camera in several)
            yield name, [draw_points(image, cloud, camera) for camera in seen]


def width_on_page(camera: Camera) -> int:
    """At most so wide are a camera's pictures shown [px]."""
    return round(_HEIGHT_PX * camera.width_px / camera.height_px)


def depth_scale() -> tuple[str, list[tuple[float, str]]]:
    """The colours of the distances, linear in their logarithm.

    Returns:
        A gradient of CSS, and its ticks: percent from the left, label.
    """
    low, high = np.log(DEPTH_RANGE_M)
    ticks = np.array(_TICKS_M)
    at = 100 * (np.log(ticks) - low) / (high - low)
    stops = depth_colours(np.exp(np.linspace(low, high, _STOPS)))
    labels = [f"{ticks[0]} m", *map(str, ticks[1:])]
    gradient = ", ".join(f"#{r:02x}{g:02x}{b:02x}" for b, g, r in stops.tolist())
    return gradient, [*zip(at.tolist(), labels, strict=True)]


def _to_jpeg(image: NDArray[np.uint8], budget: int) -> str:
    """A data URI of the largest and best JPEG of at most ``budget`` bytes."""
    data = b""
    for width, quality in _SIZES:
        data = encode(shrink(image, width), "jpeg", cv2.IMWRITE_JPEG_QUALITY, quality)
        if len(data) <= budget:
            break
    return data_uri(data, "jpeg")


def write_overlays(
    frame: Frame,
    cameras: Mapping[str, Sequence[Camera]],
    folder: Path,
    verdicts: Mapping[str, Status] | None = None,
) -> list[Path]:
    """Write a picture of every camera: the cloud on its image, by the guess, and by a result below.

    They are ``guess_CAMERA.png``; of a result, with its verdicts, ``overlay_CAMERA.png``.

    Raises:
        CalibrationError: if an image or the cloud cannot be read, or a picture not be written.
    """
    kind, first = ("guess", "guess") if verdicts is None else ("overlay", "before")
    paths = []
    for name, pictures in _draw(frame, cameras):
        titles = [f"{name}, frame {frame.name}: {first}"]
        titles += [] if verdicts is None else [f"{name}, after: {_MARKS[verdicts[name]]}"]
        panels = map(_titled, pictures, titles)
        picture = shrink(np.vstack([*panels, _depth_bar(pictures[0].shape[1])]), _MAX_WIDTH_PX)
        paths.append(folder / f"{kind}_{name}.png")
        write_bytes(paths[-1], encode(picture, "png"))
    return paths


def draw_points(image: Image, points_lidar_m: Array, camera: Camera) -> Image:
    """Draw a cloud on an image, near points over far ones, coloured by their distance.

    Args:
        image: (height, width, 3) BGR.
        points_lidar_m: (n, 3) in the LiDAR frame.
        camera: lens and extrinsic.
    """
    points = move_points(points_lidar_m, camera.T_camera_lidar)
    pixels, valid = camera.lens.project(points)
    seen, distance_m = valid & camera.in_image(pixels), np.linalg.norm(points, axis=1)
    order = np.flatnonzero(seen)[np.argsort(-distance_m[seen])]
    column, row = np.rint(pixels[order]).astype(np.intp).T
    colours, drawn = depth_colours(distance_m[order]), image.copy()
    # Larger for few points, so that all cover a fixed share.
    side = np.sqrt(_COVERED_SHARE * image.shape[0] * image.shape[1] / max(len(order), 1))
    side = int(np.clip(round(side), 1, _MAX_DOT_PX))
    for dy, dx in np.ndindex(side, side):
        rows = np.clip(row + dy - side // 2, 0, image.shape[0] - 1)
        drawn[rows, np.clip(column + dx - side // 2, 0, image.shape[1] - 1)] = colours
    return drawn


def depth_colours(distance_m: Array) -> Image:
    """(n, 3) BGR: red is near, blue is far, linear in the logarithm of the distance."""
    if not len(distance_m):  # OpenCV refuses empty arrays
        return np.empty((0, 3), np.uint8)
    low, high = np.log(DEPTH_RANGE_M)
    share = np.clip((np.log(distance_m) - low) / (high - low), 0.0, 1.0)
    levels = np.rint(255 * (1 - share)).astype(np.uint8)
    return np.asarray(cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0], dtype=np.uint8)


def _titled(image: Image, title: str) -> Image:
    scale = max(0.5, image.shape[1] / 1600)
    strip = np.zeros((round(44 * scale), image.shape[1], 3), np.uint8)
    white, thickness = (255, 255, 255), max(1, round(1.5 * scale))
    origin = (round(12 * scale), round(30 * scale))
    cv2.putText(
        strip, title, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.8 * scale, white, thickness, cv2.LINE_AA
    )
    return np.vstack([strip, image])


def _depth_bar(width: int) -> Image:
    """A strip with the colours of the distances, with labels."""
    scale = max(0.5, width / 1600)
    low, high = np.log(DEPTH_RANGE_M)
    distances = np.exp(np.linspace(low, high, width))
    bar = np.repeat(depth_colours(distances)[None], round(_BAR_PX * scale), axis=0)
    for tick in _TICKS_M:
        x = int((np.log(tick) - low) / (high - low) * (width - 1))
        for colour, thickness in (((0, 0, 0), 4), ((255, 255, 255), 1)):  # outlined
            cv2.putText(
                bar, f"{tick} m", (x + 4, round(24 * scale)), cv2.FONT_HERSHEY_SIMPLEX,
                0.7 * scale, colour, max(1, round(thickness * scale)), cv2.LINE_AA,
            )  # fmt: skip
    return bar


def shrink(image: Image, max_width_px: int) -> Image:
    """The image, scaled down to at most this width."""
    factor = max_width_px / image.shape[1]
    if factor >= 1:
        return image
    size = (max_width_px, max(1, round(image.shape[0] * factor)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


class LidarViews(NamedTuple):
    """Pictures of one instant as data URIs.

    Attributes:
        colours: of each LiDAR.
        tops: from above, ``before``, of the LiDARs with a guess, and ``after``.
        side: the ground after the calibration, its height stretched.
    """

    colours: Mapping[str, str]
    tops: Mapping[str, str]
    side: str


def draw_lidars(result: Calibration) -> tuple[LidarViews | None, str]:
    """One instant, its points as recorded, one colour a LiDAR; or why it cannot be drawn."""
    names = result.rig.all_lidars
    frames = [entry for entry in result.frames if len(entry.get("lidars", ())) == len(names) - 1]
    if not frames:
        return None, "the result names no instant with all clouds"
    frame = frame_of_entry(frames[len(frames) // 2])
    try:
        clouds = {name: frame.load_recorded(name, timed=False)[0] for name in names}
    except (CalibrationError, OSError) as error:
        return None, str(error)
    after, before = result.T_base_lidar, result.initial_rig.T_base_lidar
    every = np.concatenate([move_points(cloud, after[name]) for name, cloud in clouds.items()])
    try:
        T_up_base = find_upright(names[0], [every])
    except CalibrationError:  # no ground
        T_up_base = np.eye(4)
    colours = {name: _COLOURS[number % len(_COLOURS)] for number, name in enumerate(names)}
    placed = {"before": before, "after": after}
    points = {
        title: {name: move_points(clouds[name], T_up_base @ T) for name, T in poses.items()}
        for title, poses in placed.items()
        if len(poses) > 1
    }
    square = np.array([[-_REACH_M, _REACH_M], [-_REACH_M, _REACH_M]])
    tops = {
        title: _picture({n: of[:, :2] for n, of in at.items()}, colours, square, _TOP_PX)
        for title, at in points.items()
    }
    near = {n: of[np.abs(of[:, 1]) < _ASIDE_M][:, [0, 2]] for n, of in points["after"].items()}
    side = np.array([square[0], [_LOW_M, _HIGH_M]])
    return LidarViews(colours, tops, _picture(near, colours, side, _SIDE_PX)), ""


def _picture(
    points_m: Mapping[str, Array],
    colours: Mapping[str, str],
    extent_m: Array,
    size: tuple[int, int],
) -> str:
    """(n, 2) points of each LiDAR within (2, 2) limits, the second axis up, on a grid of 10 m."""
    image = np.full((size[1], size[0], 3), 255, np.uint8)
    low, scale = extent_m[:, 0], np.array(size) / (extent_m[:, 1] - extent_m[:, 0])
    for line in np.arange(-_REACH_M // _LINE_M + 1, _REACH_M // _LINE_M + 1) * _LINE_M:
        column, row = ((line - low) * scale).astype(int)
        image[:, column] = _LINE
        if 0 <= row < size[1]:
            image[size[1] - 1 - row] = _LINE
    for name, points in points_m.items():
        column, row = np.floor((points - low) * scale).astype(int).T
        inside = (column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])
        blue, green, red = (int(colours[name][k : k + 2], 16) for k in (5, 3, 1))
        image[size[1] - 1 - row[inside], column[inside]] = blue, green, red
    return data_uri(encode(image, "png"))
