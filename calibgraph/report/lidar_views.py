"""The clouds of several LiDARs in one picture: from above, before and after, and from the side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.frame import frame_of_entry
from calibgraph.matching.cloud_similarity import find_upright
from calibgraph.model.calibration import Calibration
from calibgraph.report.figure import new_figure, to_data_uri

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Colours that the colour-blind can tell apart (Okabe and Ito), the base first; then again.
_COLOURS = ("#000000", "#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_REACH_M, _ASIDE_M, _LOW_M, _HIGH_M = 25.0, 2.0, -0.3, 0.5  # of a picture; of its side view
_MOST_POINTS = 15_000  # of a LiDAR
_WIDTH_IN, _TOP_IN, _SIDE_IN, _MARGIN_IN = 8.8, 4.0, 1.8, 0.4


def draw_lidars(result: Calibration) -> tuple[str, str]:
    """A picture of one instant, one colour a LiDAR, as a data URI; or why there is none.

    Points are as recorded. Before the calibration it has the LiDARs with a guess.
    """
    names = result.rig.all_lidars
    frames = [entry for entry in result.frames if len(entry.get("lidars", ())) == len(names) - 1]
    if not frames:
        return "", "the result names no instant with all clouds"
    frame = frame_of_entry(frames[len(frames) // 2])
    try:
        clouds = {name: frame.load_recorded(name, timed=False)[0] for name in names}
    except (CalibrationError, OSError) as error:
        return "", str(error)
    return _picture(result, clouds), ""


def _picture(result: Calibration, clouds: Mapping[str, Array]) -> str:
    names = [*clouds]
    after = result.T_base_lidar
    before = {name: T for name, T in result.initial_rig.T_base_lidar.items() if name in clouds}
    before = before if len(before) > 1 else {}
    every = np.concatenate([_moved(cloud, after[name]) for name, cloud in clouds.items()])
    try:
        T_up_base = find_upright(names[0], [every])
    except CalibrationError:  # no ground
        T_up_base = np.eye(4)
    height = _TOP_IN + _SIDE_IN
    figure = new_figure(height, _WIDTH_IN)
    tops = [(title, poses) for title, poses in (("before", before), ("after", after)) if poses]
    for number, (title, poses) in enumerate(tops):
        left = (number + 0.5 * (2 - len(tops))) * 0.5 + 0.06
        axes = figure.add_axes((left, (_SIDE_IN + _MARGIN_IN) / height, 0.42, 3.3 / height))
        _draw(axes, clouds, {name: T_up_base @ T for name, T in poses.items()}, (0, 1))
        axes.set(xlim=(-_REACH_M, _REACH_M), ylim=(-_REACH_M, _REACH_M), aspect="equal")
        axes.set_title(f"{title}, from above [m]", fontsize=9)
    axes.legend(names, loc="upper right", markerscale=8, fontsize=7, framealpha=1.0)
    side = figure.add_axes((0.06, _MARGIN_IN / height, 0.92, (_SIDE_IN - 2 * _MARGIN_IN) / height))
    _draw(side, clouds, {name: T_up_base @ T for name, T in after.items()}, (0, 2))
    side.set(xlim=(-_REACH_M, _REACH_M), ylim=(_LOW_M, _HIGH_M))
    side.set_title(f"after, from the side: within {_ASIDE_M:g} m, over the ground [m]", fontsize=9)
    return to_data_uri(figure)


def _draw(
    axes: Axes, clouds: Mapping[str, Array], T_up_lidar: Mapping[str, Array], of: tuple[int, int]
) -> None:
    """The points of each LiDAR along two axes; from the side those near alone."""
    for number, (name, cloud) in enumerate(clouds.items()):
        points = np.empty((0, 3))
        if name in T_up_lidar:
            points = _moved(cloud[:: -(-len(cloud) // _MOST_POINTS)], T_up_lidar[name])
        if of[1] > 1:
            points = points[np.abs(points[:, 1]) < _ASIDE_M]
        colour = _COLOURS[number % len(_COLOURS)]
        axes.plot(*points[:, of].T, ".", color=colour, markersize=1.2, markeredgewidth=0)
    axes.tick_params(labelsize=8)


def _moved(points: Array, T: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])
