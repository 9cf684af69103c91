"""Shift scores: agreement of the image with each group of LiDAR windows, over a grid of shifts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.structure.directions import view_angles
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.prepared_image import PreparedImage
from calibgraph.matching.structure.schedule import Level
from calibgraph.matching.structure.score_kernel import (
    LANES,
    LINES,
    centre_grids,
    score_windows,
)
from calibgraph.matching.structure.visibility import find_in_view, find_places, find_visible
from calibgraph.matching.structure.window_weights import window_network
from calibgraph.matching.structure.windows import Windows
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
class ViewedWindows:
    """The windows of a cloud that one image shows, by groups of one direction and depth.

    Attributes:
        camera: where it is when it takes the middle row, see :func:`when_taken`.
        windows: w of them, by group.
        group: (w,) the group of each.
        image: logarithm of gray, a pixel per step, padded.
        steps_per_px: (2,) of u and v.
        places: (w, l, 2) where the image shows their members [steps].
        points_lidar_m: (g, 3) each group's mean point, in the LiDAR frame of the cloud.
        seen_lidar_m: (g, 3) the same, where a rolling shutter sees it.
    """

    camera: Camera
    windows: Windows
    group: NDArray[np.int32]
    image: NDArray[np.float32]
    steps_per_px: Array
    places: NDArray[np.int32]
    points_lidar_m: Array
    seen_lidar_m: Array


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
    seen = view_windows(
        gray, cloud, camera, level, max_windows=max_windows, twist_per_s=twist_per_s
    )
    scale, weight = seen.steps_per_px, seen.windows.weight
    reach, groups = _reach_steps(camera, level, scale), len(seen.points_lidar_m)
    grids: Grids = mmap_zeros((groups, 2 * reach + 1, 2 * reach + 1), np.float32)
    _add_scores(grids, seen, likelihood=level.fine)
    lens, T = Columns(seen.camera.lens), seen.camera.T_camera_lidar
    pixels_px, fields_of_pose = fields_px(seen.seen_lidar_m, T, lens)
    jacobian_px = np.ascontiguousarray(fields_of_pose.transpose(2, 1, 0))
    return ShiftScores(
        grids=grids,
        jacobian=jacobian_px * scale[:, None],
        points_lidar_m=seen.points_lidar_m,
        pixels_px=pixels_px,
        frame=np.full(groups, frame, np.int64),
        weights=np.bincount(seen.group, weight, minlength=groups).astype(np.float64),
        steps_per_px=scale,
    )


def view_windows(  # noqa: PLR0913 - what is seen, and how
    gray: PreparedImage,
    cloud: PreparedCloud,
    camera: Camera,
    level: Level,
    *,
    max_windows: int,
    twist_per_s: Array | None = None,
) -> ViewedWindows:
    """Select and group the windows that an image shows, and find where it shows them.

    With the twist of the LiDAR, (6,), when the camera takes it.
    """
    camera = when_taken(camera, twist_per_s)
    image, scale = gray.padded_log_gray(camera, level.step_rad, level.blur_steps)
    windows = select_windows(cloud, camera, level, max_windows=max_windows)
    T, viewpoint_m = camera.T_camera_lidar, cloud.viewpoint_lidar_m(camera)
    centres_lidar_m = windows.rays_m[:, 0] + viewpoint_m
    kept, group, groups = group_windows(centres_lidar_m @ T[:3, :3].T + T[:3, 3], level.group_rad)
    windows, centres_lidar_m = windows.select(kept), centres_lidar_m[kept]
    rays_m, seen_m = windows.rays_m, centres_lidar_m
    if twist_per_s is not None and camera.readout_s:
        moved_m = seen_at_rows(camera, rays_m + viewpoint_m, twist_per_s)
        rays_m, seen_m = (moved_m - viewpoint_m).astype(np.float32), moved_m[:, 0]
    counts = np.bincount(group, minlength=groups)
    return ViewedWindows(
        camera=camera,
        windows=windows,
        group=group,
        image=image,
        steps_per_px=scale,
        places=find_places(rays_m, viewpoint_m, camera, scale),
        points_lidar_m=_mean_by_group(centres_lidar_m, group, counts),
        seen_lidar_m=_mean_by_group(seen_m, group, counts),
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
    return cloud.tables.select(key, select)


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
    return windows.weighed(window_network()) if level.weighed else windows


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
    centres_camera_m: Array, cell_rad: float
) -> tuple[NDArray[np.intp], NDArray[np.int32], int]:
    """Group windows by direction and depth; groups of too few windows are dropped.

    Returns:
        The kept windows (k,), by group; the group of each (k,); and the number of groups.
    """
    octaves = np.log2(np.linalg.norm(centres_camera_m, axis=1)) / OCTAVES_PER_BIN
    cells = np.column_stack([view_angles(centres_camera_m) / cell_rad, octaves])
    _, cell, sizes = np.unique(name_cells(cells), return_inverse=True, return_counts=True)
    full = sizes >= MIN_GROUP_WINDOWS
    kept = np.flatnonzero(full[cell])
    group = (np.cumsum(full) - 1)[cell[kept]]
    order = np.argsort(group, kind="stable")
    return kept[order], group[order].astype(np.int32), int(np.count_nonzero(full))


def name_cells(places: Array) -> NDArray[np.int64]:
    """(n,) a number per cell of places (n, 3) on a grid of step 1, in the order of the columns."""
    cells = np.floor(places).astype(np.int64)
    if not len(cells):
        return np.empty(0, np.int64)
    cells -= cells.min(axis=0)
    rows, columns = cells[:, 1].max() + 1, cells[:, 2].max() + 1
    return np.asarray((cells[:, 0] * rows + cells[:, 1]) * columns + cells[:, 2])


def _mean_by_group(points: Array, group: NDArray[np.int32], counts: NDArray[np.int64]) -> Array:
    sums = [np.bincount(group, column, minlength=len(counts)) for column in points.T]
    return np.stack(sums, axis=1) / counts[:, None]


def _add_scores(grids: Grids, seen: ViewedWindows, *, likelihood: bool) -> None:
    """Add the windows' scores to their groups' grids, above their mean.

    At coarse levels that is of all shifts: poses that take few windows out of the image are better
    ones to propose.
    """
    windows, reach = seen.windows, (grids.shape[1] - 1) // 2
    at = seen.places, windows.counts
    origin, shape = np.array([-reach, -reach]), np.subtract(seen.image.shape, (LINES, LANES))
    score_windows(seen.image, *at, windows.basis, seen.group, origin, likelihood, grids)
    if likelihood:
        centre_grids(shape, *at, seen.group, origin, grids)
    else:
        grids -= grids.mean(axis=(1, 2), keepdims=True)
