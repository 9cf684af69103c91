"""What is burnt into images: it stands still at its pixels while the scene moves.

A date, a speed, a logo, a crosshair, the edge of a fisheye's circle or a part of the housing is no
feature of the scene, but it is at the same pixels of all images, of other cameras, too: its matches
state that the camera has not moved, or that two cameras are one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.io.images import BurntIn, Rectangle
from calibgraph.model.geometry import angle_deg
from calibgraph.model.rig import Rig
from calibgraph.parallel import map_on_cores

Mask = NDArray[np.bool_]
Edges = NDArray[np.float32]
"""(height, width, 2) unit gradients of a smaller image; zero where it is flat."""

_FRAMES, _LEAST_VIEWS = 6, 4
_SIDE_PX = 960  # larger images are reduced
_LEAST_GRADIENT = 80  # of Sobel: an edge of 20 gray levels
_ALIKE = 0.5  # share of the edges that two views have in common, from which they show the same
_PARALLEL, _EXACTLY = 0.97, 0.99  # cosine, or length of a mean of unit vectors
_MISSED = 5  # one of so many views may lack an edge: white on white is none
_GAP_PX, _LEAST_PX = 9, 40
"""Of one thing, in the reduced image: most that its parts are apart; its least edge pixels."""
_LEAST_STILL, _LEAST_EXACT, _LEAST_ACROSS = 0.3, 0.3, 0.05
"""Least shares: of a thing's edge pixels, those that stand still, on KITTI up to 0.23 where the far
scene of a straight drive moves little, in what is drawn into images from 0.36; of these, those that
do so exactly in all views; and of their directions, those across most: up to 0.02 along lanes and
roofs, which may move along themselves, and from 0.08."""
_COMPACT, _BESIDE_PX = 0.6, 20
"""Share of its rectangle from which a thing is hidden with all of it, since some of a text changes
with the time; margin then beside it, for digits at its ends."""
_ELSEWHERE_DEG = 15.0
"""Cameras that look as far apart show nothing at the same pixels, but for what is burnt in."""


def hide_burnt_in(data: Dataset, rig: Rig) -> Dataset:
    """The dataset whose images are filled where something is burnt in; itself without any."""
    found = find_burnt_in(data, rig)
    if not found:
        return data
    frames, recorded = (
        tuple(frame.with_burnt_in(found) for frame in some) for some in (data.frames, data.recorded)
    )
    return replace(data, frames=frames, recorded=recorded)


def describe_burnt_in(data: Dataset) -> list[str]:
    """A line per camera whose images are filled."""
    return [
        f"{name}: what stands still in its images while the scene moves, as a text, a logo or a "
        "part of the vehicle, is left out: "
        + "; ".join(
            f"columns {left} to {right - 1}, rows {top} to {bottom - 1}"
            for left, top, right, bottom in each.rectangles
        )
        for name, each in data.frames[0].burnt_in.items()
    ]


def find_burnt_in(data: Dataset, rig: Rig) -> dict[str, BurntIn]:
    """What stands still in the images of each camera; cameras without are left out.

    It takes three views of different scenes: of the camera, else of several that look elsewhere.
    """
    complete = [f for f in data.frames if f.image_paths.keys() >= rig.cameras.keys()]
    if len(complete) < _LEAST_VIEWS:
        complete = [f for f in data.recorded if f.image_paths.keys() >= rig.cameras.keys()]
    frames = spread_out(complete or data.frames, _FRAMES)
    jobs = [(frame, name) for name in rig.cameras for frame in frames]
    seen = map_on_cores(_edges_of, *zip(*jobs, strict=True), [rig] * len(jobs))
    views: dict[str, list[Edges]] = {}
    for (_, name), edges in zip(jobs, seen, strict=True):
        of_camera = views.setdefault(name, [])
        if edges is not None and all(_common_share(edges, one) < _ALIKE for one in of_camera):
            of_camera.append(edges)
    found = {name: _still(_with_others(name, views, rig), rig, name) for name in rig.cameras}
    return {name: each for name, each in found.items() if each is not None}


def _edges_of(frame: Frame, name: str, rig: Rig) -> Edges | None:
    """The edges of an image; None if it cannot be read, which is reported elsewhere."""
    try:
        gray = frame.load_gray(name, rig.cameras[name])
    except (CalibrationError, OSError, KeyError):
        return None
    factor = min(1.0, _SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    gradient = np.stack(cv2.spatialGradient(small), axis=2).astype(np.float32)
    size = np.hypot(gradient[..., 0], gradient[..., 1])
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size >= _LEAST_GRADIENT)
    return gradient * scale[..., None]


def _common_share(one: Edges, other: Edges) -> float:
    """The share of the edges of the view with fewer that are in the other, too; of one in nine."""
    if one.shape != other.shape:
        return 0.0
    (ax, ay), (bx, by) = (np.moveaxis(edges[::3, ::3], 2, 0) for edges in (one, other))
    fewer = min(int(np.count_nonzero((x != 0) | (y != 0))) for x, y in ((ax, ay), (bx, by)))
    common = np.count_nonzero(ax * bx + ay * by > _PARALLEL)
    return float(common / max(1, fewer))


def _with_others(name: str, views: Mapping[str, Sequence[Edges]], rig: Rig) -> list[Edges]:
    """The views of a camera; with few, also those of cameras that look elsewhere by the guess."""
    own, R = [*views[name]], rig.cameras[name].T_camera_lidar[:3, :3]
    for other, camera in rig.cameras.items():
        if len(own) < _LEAST_VIEWS and other != name and views[other] and own:
            apart = angle_deg(camera.T_camera_lidar[:3, :3] @ R.T)
            if apart > _ELSEWHERE_DEG and views[other][0].shape == own[0].shape:
                own += views[other]
    return own


def _still(views: Sequence[Edges], rig: Rig, name: str) -> BurntIn | None:
    if len(views) < _LEAST_VIEWS:
        return None
    mean = np.mean(views, axis=0)
    least = _PARALLEL * (1 - len(views) // _MISSED / len(views))
    camera = rig.cameras[name]
    mask, rectangles = np.zeros(mean.shape[:2], np.uint8), []
    for part, rectangle in _things(views, mean, least):
        mask |= part
        rectangles.append(rectangle)
    if not rectangles:
        return None
    size = camera.width_px, camera.height_px
    x, y = size[0] / mask.shape[1], size[1] / mask.shape[0]
    whole = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
    return BurntIn(
        whole,
        tuple((int(x * w), int(y * n), round(x * e), round(y * s)) for w, n, e, s in rectangles),
    )


def _things(
    views: Sequence[Edges], mean: Edges, least: float
) -> Iterator[tuple[NDArray[np.uint8], Rectangle]]:
    """The pixels of each thing with a margin, and its rectangle.

    Args:
        views: of the camera.
        mean: of them.
        least: length of it where an edge stands still.
    """
    length = np.hypot(mean[..., 0], mean[..., 1])
    near = cv2.getStructuringElement(cv2.MORPH_RECT, (_GAP_PX, _GAP_PX))
    joined = cv2.dilate((length >= least).astype(np.uint8), near)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    for number, (left, top, width, height, area) in enumerate(stats[1:].tolist(), start=1):
        inside = np.s_[top : top + height, left : left + width]
        still = (labels[inside] == number) & (length[inside] >= least)
        edges = mean[inside][still]
        if len(edges) < _LEAST_PX:
            continue
        own = labels[inside] == number
        all_edges = np.mean([np.count_nonzero(view[inside][own].any(axis=1)) for view in views])
        if len(edges) < _LEAST_STILL * all_edges:
            continue
        if np.mean(length[inside][still] > _EXACTLY) < _LEAST_EXACT:
            continue
        if np.linalg.eigvalsh(edges.T @ edges / len(edges))[0] < _LEAST_ACROSS:
            continue
        pixels, start, end = np.zeros(length.shape, np.uint8), left, left + width
        pixels[inside] = labels[inside] == number
        if area >= _COMPACT * width * height:
            beside = min(height, _BESIDE_PX)
            start, end = max(0, left - beside), min(length.shape[1], end + beside)
            pixels[top : top + height, start:end] = 1
        yield pixels, (start, top, end, top + height)
