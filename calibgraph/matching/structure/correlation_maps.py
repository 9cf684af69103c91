"""Where in its image each group of LiDAR windows could be: the basis of the global search.

As :mod:`calibgraph.structure.scores`, but at all places of the image instead of all shifts within
a small reach, and with the windows as the LiDAR sees them: these depend on the orientation of the
guess only roughly, and not on its position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from calibgraph.matching.structure.shift_scores import score_windows, small_logarithm
from calibgraph.matching.structure.windows import (
    Cloud,
    cut_windows,
    scan_angles,
    thin,
    unoccluded,
    view_angles,
)
from calibgraph.model.rig import Camera

Array = NDArray[np.float64]
Maps = NDArray[np.float32]

STEP_RAD = np.radians(0.6)  # of the angular image and of the samples in a window
STRIDE_SPACINGS = 3.0
BLUR_STEPS = 1.0
MAX_AZIMUTH_RAD, MAX_ELEVATION_RAD = np.radians(110.0), np.radians(80.0)
GROUP_RAD = np.radians(2.5)
OCTAVES_PER_BIN = 0.25
LEAST_SEEN = 0.1  # of the groups' variance: contrasts of poses that see less do not rise
MAX_CELLS = 40_000_000  # of all maps together: bounds the memory to some hundred megabytes
MARGIN_RAD = np.radians(3.0)  # beyond the image and the range: translations move points too


@dataclass(frozen=True, eq=False)
class Responses:
    """Score maps of the groups of one camera, over view angles.

    Attributes:
        maps: (g, h, w) score of the group's windows by the place [elevation, azimuth] of its
            centre, less what any group would score there; its mean over the image is zero, and so
            is everything outside the image.
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
        return np.asarray(self.maps.var(axis=(1, 2), dtype=np.float64))

    def blurred(self, steps: float, every: int = 1) -> Responses:
        """With maps blurred by a Gaussian, and only every so many rows and columns kept."""
        maps = np.stack([cv2.GaussianBlur(m, (0, 0), steps)[::every, ::every] for m in self.maps])
        return Responses(maps, self.points_lidar_m, self.origin_rad, every * self.step_rad)

    def contrasts(self, poses: Array) -> Array:
        """(n,) summed scores at poses T_camera_lidar (n, 4, 4), in standard deviations by chance.

        Only the groups that a pose sees count. Otherwise poses that see many would win, such as
        those far back, or those that see few and only the best.
        """
        out = np.zeros(len(poses))
        maps, points, T = self.maps, self.points_lidar_m, np.ascontiguousarray(poses)
        grid = np.array([*self.origin_rad, self.step_rad])
        _contrasts(maps, self.variances, points, T, grid, self._least_variance, out)
        return out

    def best_turned(self, poses: Array, reach_rad: tuple[float, float]) -> tuple[Array, Array]:
        """The best contrast near each pose when the view also moves to the right and down.

        Args:
            poses: (n, 4, 4) T_camera_lidar.
            reach_rad: how far it moves to the right and down, both ways.

        Returns:
            (n,) contrasts; (n, 2) by which angles (right, down) the view moves.
        """
        reach = np.rint(np.array(reach_rad) / self.step_rad).astype(np.int64)
        out = np.zeros((len(poses), 3))
        maps, points, T = self.maps, self.points_lidar_m, np.ascontiguousarray(poses)
        grid = np.array([*self.origin_rad, self.step_rad])
        _best_turned(maps, self.variances, points, T, grid, self._least_variance, reach, out)
        return out[:, 0], out[:, 1:] * self.step_rad

    @property
    def _least_variance(self) -> float:
        return LEAST_SEEN * float(self.variances.sum()) + 1e-12


def respond(
    grays: Sequence[NDArray[np.uint8]],
    clouds: Sequence[Cloud],
    camera: Camera,
    *,
    range_rad: float,
    most: int,
    seed: int,
) -> Responses:
    """Score the images of a camera against their clouds, at all places.

    Args:
        grays: (height, width) images.
        clouds: one per image.
        camera: lens, and the guess; only its orientation is used.
        range_rad: how far the orientation may be off, per axis.
        most: most windows per frame; fewer where the maps would be too large.
        seed: of the choice of windows.
    """
    cells = _angular_image(grays[0], camera)[1].size
    most = max(1, min(most, MAX_CELLS // (cells * len(grays))))
    one = [
        _respond(g, c, camera, range_rad, (most, seed)) for g, c in zip(grays, clouds, strict=True)
    ]
    return Responses(
        np.concatenate([r.maps for r in one]),
        np.concatenate([r.points_lidar_m for r in one]),
        one[0].origin_rad,
        one[0].step_rad,
    )


def _respond(
    gray: NDArray[np.uint8],
    cloud: Cloud,
    camera: Camera,
    range_rad: float,
    choice: tuple[int, int],
) -> Responses:
    """The responses of one frame; the choice of windows is how many at most, and a seed."""
    image, inside, origin = _angular_image(gray, camera)
    R, viewpoint_m = camera.T_camera_lidar[:3, :3], cloud.viewpoint_m(camera)
    rays_m = cloud.points_lidar_m - viewpoint_m
    angles = view_angles(rays_m @ R.T)
    end = origin + np.array(inside.shape[::-1]) * STEP_RAD
    margin = range_rad + MARGIN_RAD
    near = np.flatnonzero(((angles > origin - margin) & (angles < end + margin)).all(axis=1))
    near = near[unoccluded(angles[near], np.linalg.norm(rays_m[near], axis=1), STEP_RAD / 2)]
    near = near[thin(scan_angles(rays_m[near]), STEP_RAD)]
    windows = cut_windows(
        rays_m[near],
        cloud.rank[near],
        spacing_rad=STEP_RAD,
        stride_spacings=STRIDE_SPACINGS,
        most=choice[0],
        keep_linear=False,
        seed=choice[1],
    )
    if not len(windows.counts):
        nothing = np.zeros((0, *inside.shape), np.float32)
        return Responses(nothing, np.zeros((0, 3)), origin, float(STEP_RAD))
    drawn = windows.rays_m @ R.T
    group, centres = _groups(drawn[:, 0])
    angles = view_angles(drawn.reshape(-1, 3)).reshape(*drawn.shape[:2], 2)
    off = angles - view_angles(centres)[group][:, None]
    places = np.rint(off / STEP_RAD).astype(np.int32)
    maps = np.zeros((len(centres), *inside.shape), np.float32)
    first = np.zeros(2, np.int64)
    score_windows(image, places, windows.counts, windows.basis, group, first, False, maps)
    maps *= inside
    maps -= (maps.sum(axis=(1, 2)) / inside.sum())[:, None, None]
    counts = np.bincount(group).astype(np.float32)[:, None, None]
    maps -= counts * (maps.sum(axis=0) / counts.sum())  # places that agree with anything
    return Responses(maps * inside, centres @ R + viewpoint_m, origin, float(STEP_RAD))


def _angular_image(
    gray: NDArray[np.uint8], camera: Camera
) -> tuple[NDArray[np.float32], NDArray[np.bool_], Array]:
    """Logarithm of gray over view angles.

    Returns:
        (h, w) image [elevation, azimuth]; (h, w) what the camera sees of it; (2,) view angles
        (right, down) of its first cell.
    """
    azimuth = np.arange(-MAX_AZIMUTH_RAD, MAX_AZIMUTH_RAD, STEP_RAD)
    elevation = np.arange(-MAX_ELEVATION_RAD, MAX_ELEVATION_RAD, STEP_RAD)
    right, down = np.meshgrid(azimuth, elevation)
    rays = [np.sin(right) * np.cos(down), np.sin(down), np.cos(right) * np.cos(down)]
    pixels, valid = camera.lens.project(np.stack(rays, axis=-1).reshape(-1, 3))
    seen = (valid & camera.in_image(pixels)).reshape(right.shape)
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    small, scale = small_logarithm(gray, camera, STEP_RAD, BLUR_STEPS)
    places = ((pixels.reshape(*right.shape, 2)[part] + 0.5) * scale - 0.5).astype(np.float32)
    image = cv2.remap(
        small, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    first = np.array([azimuth[columns[0]], elevation[rows[0]]])
    return np.asarray(image, dtype=np.float32), seen[part], first


def _groups(seeds_m: Array) -> tuple[NDArray[np.int32], Array]:
    """Group windows by direction and distance: the group of each, and the groups' mean points."""
    distance = np.linalg.norm(seeds_m, axis=1)
    bins = np.floor(np.log2(distance) / OCTAVES_PER_BIN)
    cells = np.column_stack([np.floor(view_angles(seeds_m) / GROUP_RAD), bins])
    _, group, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    sums = [np.bincount(group, column, minlength=len(counts)) for column in seeds_m.T]
    return group.astype(np.int32), np.stack(sums, axis=1) / counts[:, None]


@njit(cache=True, fastmath=True, nogil=True)
def _cell(T, point, grid):  # type: ignore[no-untyped-def]
    """Place (column, row) of a point in the maps."""
    x = T[0, 0] * point[0] + T[0, 1] * point[1] + T[0, 2] * point[2] + T[0, 3]
    y = T[1, 0] * point[0] + T[1, 1] * point[1] + T[1, 2] * point[2] + T[1, 3]
    z = T[2, 0] * point[0] + T[2, 1] * point[1] + T[2, 2] * point[2] + T[2, 3]
    right, down = np.arctan2(x, z), np.arctan2(y, np.sqrt(x * x + z * z))
    return (right - grid[0]) / grid[2], (down - grid[1]) / grid[2]


@njit(cache=True, fastmath=True, nogil=True)
def _contrasts(maps, variances, points, poses, grid, least, out):  # type: ignore[no-untyped-def]
    """Per pose the sum of bilinearly interpolated scores, over its chance spread."""
    height, width = maps.shape[1], maps.shape[2]
    for i in range(poses.shape[0]):
        total, variance = 0.0, least
        for g in range(maps.shape[0]):
            u, v = _cell(poses[i], points[g], grid)
            if u < 0 or v < 0 or u >= width - 1 or v >= height - 1:
                continue
            a, b = int(u), int(v)
            x, y = u - a, v - b
            total += (1 - y) * ((1 - x) * maps[g, b, a] + x * maps[g, b, a + 1])
            total += y * ((1 - x) * maps[g, b + 1, a] + x * maps[g, b + 1, a + 1])
            variance += variances[g]
        out[i] = total / np.sqrt(variance)


@njit(cache=True, fastmath=True, nogil=True)
def _best_turned(maps, variances, points, poses, grid, least, reach, out):  # type: ignore[no-untyped-def]
    """Per pose (contrast, cells right, cells down) of the best shift of all groups together."""
    height, width = maps.shape[1], maps.shape[2]
    columns, rows = 2 * reach[0] + 1, 2 * reach[1] + 1
    total = np.empty((rows, columns), np.float32)
    variance = np.empty((rows + 1, columns + 1), np.float32)
    for i in range(poses.shape[0]):
        total[:], variance[:] = 0, 0
        for g in range(maps.shape[0]):
            u, v = _cell(poses[i], points[g], grid)
            left, top = int(np.rint(u)) - reach[0], int(np.rint(v)) - reach[1]
            first, last = max(0, -left), min(columns, width - left)
            above, below = max(0, -top), min(rows, height - top)
            if first >= last or above >= below:
                continue
            for row in range(above, below):
                for column in range(first, last):
                    total[row, column] += maps[g, top + row, left + column]
            variance[above, first] += variances[g]  # corners of a box, summed up below
            variance[above, last] -= variances[g]
            variance[below, first] -= variances[g]
            variance[below, last] += variances[g]
        for row in range(rows):
            for column in range(1, columns):
                variance[row, column] += variance[row, column - 1]
        for row in range(rows):
            for column in range(columns):
                if row > 0:
                    variance[row, column] += variance[row - 1, column]
                total[row, column] /= np.sqrt(variance[row, column] + np.float32(least))
        best = total.argmax()
        out[i, 0] = total[best // columns, best % columns]
        out[i, 1] = best % columns - reach[0]
        out[i, 2] = best // columns - reach[1]
