"""The time offset between images and clouds, from residuals that follow the image motion.

The pixel of a point that was seen later has moved by (time offset) x (image motion). Regressing the
residuals of the correspondences on the image motion, together with the extrinsic, gives the offset.
Any matcher's correspondences will do.

A constant motion straight ahead is equivalent to a camera that is mounted further ahead: the offset
is observable only where the motion varies between frames, which its sigma includes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.model.clock import at_pixels
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera, Rig
from calibgraph.solver.linear_fit import MIN_ROWS, block_of, fit_camera

Gray = NDArray[np.uint8]

MAX_ROWS = 200  # per camera and frame: more of dense matches add no information
MAX_FRAMES = 24  # evenly spread over those with a neighbour: bounds the time
MIN_MOVING_FRAMES = 4  # that move: with fewer, a single frame decides
MIN_MOTION_PX = 0.5  # median image motion per frame: below, the vehicle stands
RETURN_PX = 1.0  # a pixel tracked forth and back must end this near
SYSTEMATIC_PX = 0.15
"""Error of the matches that follows the motion without a time offset. On sequence 00 (even motion,
no offset) it made offsets of 0.03 to 0.17 intervals."""
_WINDOW, _LEVELS = (21, 21), 4  # of the pyramids of the flow


@dataclass(frozen=True)
class TimeOffset:
    """The time offset of one camera's images to the clouds.

    Attributes:
        intervals: how much later the images are than the clouds, in frame intervals.
        sigma: its standard deviation: the scatter of the frames, and the effect of systematic
            errors of the matches where a pose explains most of the motion.
        frames: frames that it comes from.
        motion_px: median image motion per frame interval.
    """

    intervals: float
    sigma: float
    frames: int
    motion_px: float


def time_offsets(dataset: Dataset, rig: Rig, table: Correspondences) -> dict[str, TimeOffset]:
    """The time offset of every camera whose correspondences and image motion determine it.

    Args:
        dataset: the images; neighbouring frames of a folder must be neighbours in time.
        rig: lenses, and the extrinsics of the result.
        table: the correspondences of the result, distorted pixels.
    """
    found = {}
    for name, camera in rig.cameras.items():
        rows = at_pixels(camera, table.of_camera(name))
        motion = image_motion(dataset, name, camera, rows)
        offset = time_offset(camera, rows, motion)
        if offset is not None:
            found[name] = offset
    return found


def time_offset(camera: Camera, table: Correspondences, motion_px: Array) -> TimeOffset | None:
    """Fit extrinsic and time offset to one camera's correspondences.

    Args:
        camera: lens, and the extrinsic of the result.
        table: the rows of this camera.
        motion_px: (n, 2) image motion at each row's pixel per frame interval; NaN if unknown.

    Returns:
        The offset, or None if too few rows or frames move.
    """
    known = np.flatnonzero(np.isfinite(motion_px).all(axis=1))
    table, motion_px = table.select(known), motion_px[known]
    frames = len(np.unique(table.frame))
    if len(table) < MIN_ROWS or frames < MIN_MOVING_FRAMES:
        return None
    typical = float(np.median(np.linalg.norm(motion_px, axis=1)))
    if typical < MIN_MOTION_PX:
        return None
    rows = np.argsort(table.frame, kind="stable")
    fit = fit_camera(camera, block_of(camera, table), motion_px[rows].T[None])
    if fit is None:
        return None
    free = fit.free(0)
    sigma = float(np.hypot(free.sigmas[0], SYSTEMATIC_PX / (free.independent_shares[0] * typical)))
    return TimeOffset(float(free.values[0]), sigma, frames, typical)


def image_motion(dataset: Dataset, name: str, camera: Camera, table: Correspondences) -> Array:
    """(n, 2) motion of each row's pixel per frame interval; NaN where it is not known.

    The mean of the motions from the previous and to the next image; one of them at either end.
    Evenly spread frames and rows are tracked.
    """
    motion = np.full((len(table), 2), np.nan)
    with_rows = set(np.unique(table.frame).tolist())
    used = [frame for frame in dataset.frames if frame.index in with_rows]
    moving = [frame for frame in used if _neighbours(dataset, frame)]
    images: dict[int, Gray] = {}
    for frame in spread_out(moving, MAX_FRAMES):
        near = _neighbours(dataset, frame)
        wanted = {frame.index: frame, **{other.index: other for other, _ in near}}
        images = {
            index: images[index] if index in images else other.load_gray(name, camera)
            for index, other in wanted.items()
        }
        rows = np.flatnonzero(table.frame == frame.index)
        rows = rows[:: -(-len(rows) // MAX_ROWS)]
        steps = [
            sign * _tracked(images[frame.index], images[other.index], table.pixels_px[rows])
            for other, sign in near
        ]
        motion[rows] = np.mean(steps, axis=0)
    return motion


def _neighbours(dataset: Dataset, frame: Frame) -> list[tuple[Frame, int]]:
    """The frames before (-1) and after (1) of the same folder, where there are any."""
    near = [(dataset.neighbour(frame, sign), sign) for sign in (-1, 1)]
    return [(other, sign) for other, sign in near if other is not None]


def _tracked(image: Gray, other: Gray, pixels_px: Array) -> Array:
    """(n, 2) motion from an image to another by sparse flow; NaN where it does not track back."""
    start = pixels_px.astype(np.float32).reshape(-1, 1, 2)
    options = {"winSize": _WINDOW, "maxLevel": _LEVELS}
    there, found, _ = cv2.calcOpticalFlowPyrLK(image, other, start, None, **options)  # type: ignore[call-overload]
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, image, there, None, **options)  # type: ignore[call-overload]
    good = (found * returned).reshape(-1).astype(bool)
    good &= np.linalg.norm((back - start).reshape(-1, 2), axis=1) < RETURN_PX
    motion: Array = np.asarray((there - start).reshape(-1, 2), dtype=np.float64)
    motion[~good] = np.nan
    return motion
