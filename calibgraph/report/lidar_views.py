"""The clouds of several LiDARs as pictures without text: from above, and from the side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.frame import frame_of_entry
from calibgraph.matching.cloud_similarity import find_upright
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import move_points
from calibgraph.report.kit import data_uri, encode

# RGB colours that the colour-blind can tell apart (Okabe and Ito), the base first; then again.
_COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_REACH_M, _ASIDE_M, _LOW_M, _HIGH_M = 25.0, 2.0, -0.3, 0.5  # of a picture; of its side view
_TOP_PX, _SIDE_PX, _LINE_M, _LINE = (500, 500), (1000, 160), 10.0, (225, 225, 225)


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
