"""Correlation maps: agreement of the image with each group of LiDAR windows, at all its places.

As :mod:`calibgraph.matching.structure.shift_scores`, but over the whole image in place of a small
reach, and with windows as the LiDAR sees them: these depend only roughly on the orientation of the
guess, and not on its position. The global search reads its z-scores from these maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.structure.correlation_kernels import find_best_shifts, sum_z_scores
from calibgraph.matching.structure.directions import find_visible, view_angles
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.prepared_image import PreparedImage
from calibgraph.matching.structure.score_kernel import LANES, LINES, pad, score_windows
from calibgraph.matching.structure.shift_scores import group_windows, mean_by_group
from calibgraph.matching.structure.windows import Windows
from calibgraph.model.rig import Camera

Maps = NDArray[np.float32]

STEP_RAD = np.radians(0.6)  # of the angular image and of the samples in a window
STRIDE_SPACINGS, DENSE_SPACINGS = 3.0, 1.5  # of the windows; the latter with few frames
BLUR_STEPS = 1.0
MAX_AZIMUTH_RAD, MAX_ELEVATION_RAD = np.radians(110.0), np.radians(80.0)
GROUP_RAD = np.radians(2.5)
OCTAVES_PER_BIN = 0.25
MIN_VARIANCE_SHARE = 0.1  # of all groups' variance: z-scores of poses that see less do not rise
MAX_CELLS = 40_000_000  # of all maps together: bounds the memory to some hundred megabytes
CHANCE = 0.4  # of an unrelated window's share: the mean score of all windows is subtracted as well
MARGIN_RAD = np.radians(3.0)  # beyond the image and the range: translations move points too


@dataclass(frozen=True, eq=False)
class CorrelationMaps:
    """Score maps of the groups of one camera, over view angles.

    Attributes:
        maps: (g, h, w) score of the group's windows by the place [elevation, azimuth] of its
            centre, less the mean score of all windows there; its mean over the image is zero, and
            so is everything outside the image.
        points_lidar_m: (g, 3) each group's centre, in the LiDAR frame.
        origin_rad: (2,) view angles (right, down) of the first cell.
        step_rad: between cells.
    """

    maps: Maps
    points_lidar_m: Array
    origin_rad: Array
    step_rad: float

    @cached_property
    def variances(self) -> Array:
        """(g,) of each map over its places."""
        squares = [cv2.norm(each, cv2.NORM_L2SQR) for each in self.maps]  # a fifth of np.var's time
        means = [cv2.mean(each)[0] for each in self.maps]
        return np.asarray(np.array(squares) / self.maps[0].size - np.array(means) ** 2)

    def blur(self, sigma_cells: float, every: int = 1) -> CorrelationMaps:
        """Blur the maps by a Gaussian and subsample their rows and columns."""
        maps = [cv2.GaussianBlur(m, (0, 0), sigma_cells)[::every, ::every] for m in self.maps]
        step_rad = every * self.step_rad
        return CorrelationMaps(np.stack(maps), self.points_lidar_m, self.origin_rad, step_rad)

    def z_scores(self, T_camera_lidar: Array) -> Array:
        """(n,) summed scores at (n, 4, 4) transforms, in standard deviations of chance agreement.

        Only the groups that a camera there sees are counted. Otherwise poses that see many would
        win, such as those far back, or those that see few and only the best.
        """
        out = np.zeros(len(T_camera_lidar))
        sum_z_scores(*self._given(T_camera_lidar), out)
        return out

    def find_best_shifts(
        self, T_camera_lidar: Array, reach_rad: tuple[float, float]
    ) -> tuple[Array, Array]:
        """Find the best z-score near each transform when the view shifts to the right and down.

        Args:
            T_camera_lidar: (n, 4, 4).
            reach_rad: largest shifts to the right and down, in both directions.

        Returns:
            (n,) z-scores; (n, 2) angles (right, down) by which the view shifts [rad].
        """
        reach = np.rint(np.array(reach_rad) / self.step_rad).astype(np.int64)
        out = np.zeros((len(T_camera_lidar), 3))
        find_best_shifts(*self._given(T_camera_lidar), reach, out)
        return out[:, 0], out[:, 1:] * self.step_rad

    @property
    def _variance_floor(self) -> float:
        return MIN_VARIANCE_SHARE * float(self.variances.sum()) + 1e-12

    def _given(self, T: Array) -> tuple[Any, ...]:
        """What both kernels are given; the first three rows of transforms as columns (12, n)."""
        columns = np.ascontiguousarray(T[:, :3].reshape(len(T), 12).T, dtype=np.float32)
        grid = np.array([*self.origin_rad, self.step_rad])
        floor = self._variance_floor
        return self.maps, self.variances, self.points_lidar_m, columns, grid, floor


@dataclass(frozen=True, eq=False)
class _AngularImage:
    """An image over view angles.

    Attributes:
        log_gray: (h, w) logarithm of gray by [elevation, azimuth].
        inside: (h, w) which cells the camera sees.
        origin_rad: (2,) view angles (right, down) of the first cell.
    """

    log_gray: NDArray[np.float32]
    inside: NDArray[np.bool_]
    origin_rad: Array


def correlate(
    grays: Sequence[PreparedImage],
    clouds: Sequence[PreparedCloud],
    camera: Camera,
    cores: Executor,
    *,
    range_rad: float,
    max_windows: int,
    dense: bool = False,
    seed: int,
) -> CorrelationMaps:
    """Correlate the images of a camera with their clouds, at all places.

    The windows of a frame are at most so many, drawn by the seed; if dense, twice as close.
    """
    images = [_to_angular_image(gray, camera) for gray in grays]
    cells = images[0].log_gray.size
    max_windows = max(1, min(max_windows, MAX_CELLS // (cells * len(grays))))
    stride = DENSE_SPACINGS if dense else STRIDE_SPACINGS
    cut = partial(
        _cut_windows_in_reach,
        camera=camera, range_rad=range_rad, stride=stride, max_windows=max_windows, seed=seed,
    )  # fmt: skip

    def correlate_frame(image: _AngularImage, cloud: PreparedCloud) -> CorrelationMaps:
        return _correlate_frame(image, cloud, cut(image, cloud), camera)

    frames = list(cores.map(correlate_frame, images, clouds))
    return CorrelationMaps(
        np.concatenate([frame.maps for frame in frames]),
        np.concatenate([frame.points_lidar_m for frame in frames]),
        frames[0].origin_rad,
        frames[0].step_rad,
    )


def _correlate_frame(
    image: _AngularImage, cloud: PreparedCloud, windows: Windows, camera: Camera
) -> CorrelationMaps:
    """The maps of the windows of one frame."""
    if not len(windows):
        nothing = np.zeros((0, *image.inside.shape), np.float32)
        return CorrelationMaps(nothing, np.zeros((0, 3)), image.origin_rad, float(STEP_RAD))
    R = camera.T_camera_lidar[:3, :3]
    centres_m = windows["rays_m"][:, 0] @ R.T
    order, group, counts = group_windows(centres_m, GROUP_RAD, OCTAVES_PER_BIN)
    windows, centres = windows[order], mean_by_group(centres_m[order], group, counts)
    turned = windows["rays_m"] @ R.T
    angles = view_angles(turned.reshape(-1, 3)).reshape(*turned.shape[:2], 2)
    off_centre = angles - view_angles(centres)[group][:, None]
    places = np.rint(off_centre / STEP_RAD).astype(np.int32)
    maps = _score_maps(image, places, windows, group, groups=len(centres))
    points_lidar_m = centres @ R + cloud.viewpoint_lidar_m(camera)
    return CorrelationMaps(maps, points_lidar_m, image.origin_rad, float(STEP_RAD))


def _cut_windows_in_reach(
    image: _AngularImage,
    cloud: PreparedCloud,
    *,
    camera: Camera,
    range_rad: float,
    stride: float,
    max_windows: int,
    seed: int,
) -> Windows:
    """Windows of the part of the cloud that the camera may see from anywhere in the range."""
    R, origin = camera.T_camera_lidar[:3, :3], image.origin_rad
    rays_m = (cloud.points_lidar_m - cloud.viewpoint_lidar_m(camera)) @ R.T
    angles = view_angles(rays_m)
    end = origin + np.array(image.inside.shape[::-1]) * STEP_RAD
    margin = range_rad + MARGIN_RAD
    near = ((angles > origin - margin) & (angles < end + margin)).all(axis=1)
    if not cloud.seen_from_origin:
        distance_m = np.linalg.norm(rays_m[near], axis=1)
        near[near] = find_visible(angles[near], distance_m, STEP_RAD / 2)
    table = cloud.windows(camera, near, STEP_RAD, stride, fine=False)
    return table.cut(near, near, max_covered=1.0, max_windows=max_windows, seed=seed)


def _score_maps(
    image: _AngularImage,
    places: NDArray[np.int32],
    windows: Windows,
    group: NDArray[np.int32],
    *,
    groups: int,
) -> Maps:
    """(g, h, w) the maps of a frame, see ``CorrelationMaps.maps``."""
    inside = image.inside
    maps = np.zeros((groups, *inside.shape), np.float32)
    first = np.zeros(2, np.int64)
    of_windows = windows["count"], windows["basis"]
    score_windows(pad(image.log_gray), places, *of_windows, group, first, False, maps, CHANCE)
    maps *= inside
    maps -= (maps.sum(axis=(1, 2)) / inside.sum())[:, None, None]
    counts = np.bincount(group).astype(np.float32)[:, None, None]
    maps -= counts * (maps.sum(axis=0) / counts.sum())  # places that agree with anything
    return np.asarray(maps * inside)


def _to_angular_image(image: PreparedImage, camera: Camera) -> _AngularImage:
    """Resample an image over view angles."""
    azimuth = np.arange(-MAX_AZIMUTH_RAD, MAX_AZIMUTH_RAD, STEP_RAD)
    elevation = np.arange(-MAX_ELEVATION_RAD, MAX_ELEVATION_RAD, STEP_RAD)
    right, down = np.meshgrid(azimuth, elevation)
    rays = [np.sin(right) * np.cos(down), np.sin(down), np.cos(right) * np.cos(down)]
    pixels, valid = camera.lens.project(np.stack(rays, axis=-1).reshape(-1, 3))
    seen = (valid & camera.in_image(pixels)).reshape(right.shape)
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    padded, scale = image.log_gray(camera, STEP_RAD, BLUR_STEPS)
    places = ((pixels.reshape(*right.shape, 2)[part] + 0.5) * scale - 0.5).astype(np.float32)
    remapped = cv2.remap(
        padded[:-LINES, :-LANES],
        places[..., 0],
        places[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    origin_rad = np.array([azimuth[columns[0]], elevation[rows[0]]])
    return _AngularImage(np.asarray(remapped, dtype=np.float32), seen[part], origin_rad)
