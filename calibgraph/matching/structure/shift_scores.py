"""Shift scores: agreement of the image with each group of LiDAR windows, over a grid of shifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, name_cells
from calibgraph.matching.structure.directions import (
    find_in_view,
    find_places,
    find_visible,
    view_angles,
)
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.prepared_image import PreparedImage
from calibgraph.matching.structure.schedule import Level
from calibgraph.matching.structure.score_kernel import score_windows
from calibgraph.matching.structure.window_weights import window_network
from calibgraph.matching.structure.windows import Windows, weigh
from calibgraph.memory import mmap_zeros
from calibgraph.model.clock import seen_at_rows, when_taken
from calibgraph.model.rig import Camera
from factors import Columns, fields_px

Grids = NDArray[np.float32]

OCTAVES_PER_BIN = 0.5  # depth bin of a group, so that its parallax is nearly constant
MIN_GROUP_WINDOWS = 4
MIN_REACH_STEPS = 6  # with wide or small lenses a pixel is much of a level's reach
MAX_COVERED = 0.3  # share of a window that something nearer may cover at a coarse level
OCCLUSION_SPACINGS = 1.5  # occlusion cell in sample spacings: about one sample each


@dataclass(frozen=True, eq=False)
class ShiftScores:
    """Score grids of the groups of one camera.

    Attributes:
        grids: (g, s, s) score by shift [v, u], from -reach to reach steps; the mean is zero.
        jacobian: (g, 2, 6 + k) derivative of the shift in steps (u, v) by the twist xi = (rotation
            [rad], translation [m]) of T_camera_lidar = exp(xi) estimate, and by further unknowns.
        points_lidar_m: (g, 3) each group's mean point, in the LiDAR frame.
        pixels_px: (g, 2) where it projects at the estimate.
        frame: (g,) the number of its frame.
        weights: (g,) sums over the windows of the group, see ``Windows.weight``.
        steps_per_px: (2,) of u and v.
    """

    grids: Grids
    jacobian: Array
    points_lidar_m: Array
    pixels_px: Array
    frame: NDArray[np.int64]
    weights: Array
    steps_per_px: Array

    @cached_property
    def chance_sigma(self) -> float:
        """Standard deviation of the summed score over unrelated shifts: the unit of z-scores."""
        squares = cv2.norm(self.grids.reshape(-1, 1), cv2.NORM_L2SQR)  # in double precision
        return float(np.sqrt(squares / self.grids[0].size)) if len(self.grids) else 0.0

    def with_unknowns(self, fields_px: Array) -> ShiftScores:
        """The same scores, with (k, 2, g) derivatives of the pixels by further unknowns."""
        columns = fields_px.transpose(2, 1, 0) * self.steps_per_px[:, None]
        return replace(self, jacobian=np.concatenate([self.jacobian, columns], axis=2))


def score_frame(  # noqa: PLR0913 - what is scored, and how
    gray: PreparedImage,
    cloud: PreparedCloud,
    camera: Camera,
    level: Level,
    *,
    frame: int,
    max_windows: int,
    twist_per_s: Array | None = None,
) -> ShiftScores:
    """Score one image against one cloud, about the camera's estimated pose.

    With the twist of the LiDAR, (6,), when the camera takes it.
    """
    camera = when_taken(camera, twist_per_s)
    image, scale = gray.log_gray(camera, level.step_rad, level.blur_steps)
    windows = select_windows(cloud, camera, level, max_windows=max_windows)
    T, viewpoint_m = camera.T_camera_lidar, cloud.viewpoint_lidar_m(camera)
    centres_m = windows["rays_m"][:, 0] + viewpoint_m
    kept, group, counts = group_windows(
        centres_m @ T[:3, :3].T + T[:3, 3], level.group_rad, OCTAVES_PER_BIN, MIN_GROUP_WINDOWS
    )
    windows, centres_m = windows[kept], centres_m[kept]
    rays_m, seen_m = windows["rays_m"], centres_m
    if twist_per_s is not None and camera.readout_s:  # where a rolling shutter sees them
        moved_m = seen_at_rows(camera, rays_m + viewpoint_m, twist_per_s)
        rays_m, seen_m = (moved_m - viewpoint_m).astype(np.float32), moved_m[:, 0]
    side = 2 * _reach_steps(camera, level, scale) + 1
    grids: Grids = mmap_zeros((len(counts), side, side), np.float32)
    places = find_places(rays_m, viewpoint_m, camera, scale)
    _add_scores(grids, image, places, windows, group, likelihood=level.fine)
    pixels_px, fields = fields_px(mean_by_group(seen_m, group, counts), T, Columns(camera.lens))
    return ShiftScores(
        grids=grids,
        jacobian=np.ascontiguousarray(fields.transpose(2, 1, 0)) * scale[:, None],
        points_lidar_m=mean_by_group(centres_m, group, counts),
        pixels_px=pixels_px,
        frame=np.full(len(counts), frame, np.int64),
        weights=np.bincount(group, windows["weight"], minlength=len(counts)).astype(np.float64),
        steps_per_px=scale,
    )


def select_windows(
    cloud: PreparedCloud, camera: Camera, level: Level, *, max_windows: int
) -> Windows:
    """The windows of a cloud that a camera sees from its estimated pose.

    Those of coarse levels are kept a while: the images of neighbouring frames are compared with it.
    """
    select = partial(_select_windows, cloud, camera, level, max_windows=max_windows)
    if level.fine:
        return select()
    lens = camera.lens.kind, camera.lens.packed.tobytes(), camera.width_px, camera.height_px
    cut = level.spacing_rad, level.stride_spacings, level.weighed
    key = cloud.identity, camera.T_camera_lidar.tobytes(), lens, cut, max_windows
    kept: Windows = cloud.derived.get(key, select)
    return kept


def _select_windows(
    cloud: PreparedCloud, camera: Camera, level: Level, *, max_windows: int
) -> Windows:
    index, angles, distance_m = find_in_view(cloud.points_lidar_m, camera)
    visible = find_visible(angles, distance_m, OCCLUSION_SPACINGS * level.spacing_rad)
    in_view, clear = np.zeros((2, len(cloud.points_lidar_m)), np.bool_)
    in_view[index], clear[index[visible]] = True, True
    table = cloud.windows(
        camera,
        in_view if level.fine else clear,
        level.spacing_rad,
        level.stride_spacings,
        fine=level.fine,
    )
    max_covered = 0.0 if level.fine else MAX_COVERED
    windows = table.cut(in_view, clear, max_covered=max_covered, max_windows=max_windows)
    return weigh(windows, window_network()) if level.weighed else windows


def concatenate_scores(scores: Sequence[ShiftScores]) -> ShiftScores:
    """The groups of several frames of one camera in one object."""
    if len(scores) == 1:
        return scores[0]
    columns = ("jacobian", "points_lidar_m", "pixels_px", "frame", "weights")
    stacked = {name: np.concatenate([getattr(s, name) for s in scores]) for name in columns}
    grids: Grids = mmap_zeros((len(stacked["weights"]), *scores[0].grids.shape[1:]), np.float32)
    np.concatenate([s.grids for s in scores], out=grids)
    return ShiftScores(**stacked, grids=grids, steps_per_px=scores[0].steps_per_px)


def crop_grids(scores: ShiftScores, camera: Camera, level: Level) -> ShiftScores:
    """The same scores, with grids cropped to the reach of a level that has the same step."""
    cut = (scores.grids.shape[1] - 1) // 2 - _reach_steps(camera, level, scores.steps_per_px)
    grids = scores.grids[:, cut:-cut, cut:-cut] if cut > 0 else scores.grids
    return replace(scores, grids=grids - grids.mean(axis=(1, 2), keepdims=True))


def _reach_steps(camera: Camera, level: Level, steps_per_px: Array) -> int:
    reach = level.reach_rad * camera.lens.pixels_per_rad * steps_per_px.max()
    return max(int(np.ceil(reach)), MIN_REACH_STEPS)


def pad_grids(scores: Sequence[ShiftScores]) -> list[ShiftScores]:
    """The same scores with all grids as large as the largest: shifts beyond count 0."""
    size = max(one.grids.shape[1] for one in scores)
    margins = [(size - one.grids.shape[1]) // 2 for one in scores]
    return [
        replace(one, grids=np.pad(one.grids, ((0, 0), (margin,) * 2, (margin,) * 2)))
        if margin
        else one
        for one, margin in zip(scores, margins, strict=True)
    ]


def group_windows(
    centres_m: Array, cell_rad: float, octaves_per_bin: float, least: int = 1
) -> tuple[NDArray[np.intp], NDArray[np.int32], NDArray[np.int64]]:
    """Group windows by direction and distance; groups of less than ``least`` are dropped.

    Returns:
        The kept windows (k,), by group; the group of each (k,); and the windows of each (g,).
    """
    octaves = np.log2(np.linalg.norm(centres_m, axis=1)) / octaves_per_bin
    cells = np.column_stack([view_angles(centres_m) / cell_rad, octaves])
    _, cell, sizes = np.unique(name_cells(cells), return_inverse=True, return_counts=True)
    full = sizes >= least
    kept = np.flatnonzero(full[cell])
    group = (np.cumsum(full) - 1)[cell[kept]]
    order = np.argsort(group, kind="stable")
    return kept[order], group[order].astype(np.int32), sizes[full]


def mean_by_group(points: Array, group: NDArray[np.int32], counts: NDArray[np.int64]) -> Array:
    """(g, 3) the mean of each group's points."""
    sums = [np.bincount(group, column, minlength=len(counts)) for column in points.T]
    return np.stack(sums, axis=1) / counts[:, None]


def _add_scores(
    grids: Grids,
    image: NDArray[np.float32],
    places: NDArray[np.int32],
    windows: Windows,
    group: NDArray[np.int32],
    *,
    likelihood: bool,
) -> None:
    """Add the windows' scores to their groups' grids, above their mean.

    At coarse levels that is of all shifts: poses that take few windows out of the image are better
    ones to propose.
    """
    reach = (grids.shape[1] - 1) // 2
    at, origin = (places, windows["count"], windows["basis"], group), np.array([-reach, -reach])
    inside = score_windows(image, *at, origin, likelihood, grids)
    if likelihood:
        subtract_mean_score(grids, inside)
    else:
        grids -= grids.mean(axis=(1, 2), keepdims=True)


def subtract_mean_score(grids: Grids, inside: Grids) -> None:
    """Subtract the mean score of a window from each grid, as often as windows are in the image.

    A window that leaves the image counts 0, as an unrelated one does in the mean: subtracted from
    all shifts alike, the mean would hold windows near the border in the image, and with them the
    ground below the camera, by pitch and height.
    """
    seen = np.maximum(inside.sum(axis=(1, 2), keepdims=True), 1)
    grids -= inside * (grids.sum(axis=(1, 2), keepdims=True) / seen)
