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
from calibgraph.io.burnt_in import BurntIn, Rectangle
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
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
_PARALLEL = 0.97  # cosine, or length of a mean of unit vectors
_MISSED = 5  # one of so many views may lack an edge: white on white is none
_CORNERS = 0.1
"""Least share of the directions of a thing's edges that is across most of them: what has one
direction alone, as a lane or a kerb, may move along itself."""
_GAP_PX, _LEAST_PX, _LEAST_SHARE = 9, 40, 0.4
"""Of one burnt-in thing, in the reduced image: most that its parts are apart; least number of edge
pixels that stand still, and their share of the edge pixels in its rectangle, some of which change
with the time. By chance, parallel edges of different views meet in single places."""
_BESIDE_PX = 20  # margin beside a line of text, for digits that change
_LARGEST = 0.15  # share of the image, up to which all of the rectangle is taken, not its edges
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
    a, b = (edges[::3, ::3].reshape(-1, 2) for edges in (one, other))
    fewer = min(int(np.count_nonzero(edges.any(axis=1))) for edges in (a, b))
    common = int(np.count_nonzero((a * b).sum(axis=1) > _PARALLEL))
    return common / max(1, fewer)


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
    still, edges = np.linalg.norm(mean, axis=2) >= least, np.any(views[0], axis=2)
    camera = rig.cameras[name]
    mask, rectangles = np.zeros(still.shape, np.uint8), []
    for part, rectangle in _things(mean, still, edges):
        left, top, right, bottom = rectangle
        if (right - left) * (bottom - top) <= _LARGEST * mask.size:
            mask[top:bottom, left:right] = 1
        else:
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


def _things(mean: Edges, still: Mask, edges: Mask) -> Iterator[tuple[NDArray[np.uint8], Rectangle]]:
    """The pixels of each thing with a margin, and its rectangle."""
    near = cv2.getStructuringElement(cv2.MORPH_RECT, (_GAP_PX, _GAP_PX))
    joined = cv2.dilate(still.astype(np.uint8), near)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(joined)
    for number, (left, top, width, height, _) in enumerate(stats[1:].tolist(), start=1):
        inside = np.s_[top : top + height, left : left + width]
        part = labels[inside] == number
        stands = mean[inside][still[inside] & part]
        if len(stands) < max(_LEAST_PX, _LEAST_SHARE * np.count_nonzero(edges[inside] & part)):
            continue
        if np.linalg.eigvalsh(stands.T @ stands / len(stands))[0] < _CORNERS:
            continue
        pixels = np.zeros(still.shape, np.uint8)
        pixels[inside] = part
        beside = min(height, _BESIDE_PX)
        right = min(still.shape[1], left + width + beside)
        yield pixels, (max(0, left - beside), top, right, top + height)
