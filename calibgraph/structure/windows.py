"""LiDAR windows: neighbourhoods of points as a camera sees them, and what varies in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from calibgraph.rig import Camera
from calibgraph.structure.level import Level

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Mask = NDArray[np.bool_]

MIN_RANGE_M = 1.5  # nearer returns are the vehicle itself
WINDOW_POINTS = 25  # samples of a window; fewer cannot hold an edge and both its sides
MIN_WINDOW_POINTS = 9
WINDOW_STRETCH = 4.0  # longest window by the radius of an even one: room for single scan lines
MIN_SPACING_RAD = np.radians(0.15)  # few sensors sample more finely along their scan lines
INTENSITY_NOISE = 0.05  # intensity ranks: below, a window counts as flat
DEPTH_NOISE = 0.03  # relative inverse range: below, a window counts as flat
MIN_TEXTURE = 0.3  # least reliability of a window's contrast (0 flat, 1 strong)
OCCLUSION_SPACINGS = 1.5  # occlusion cell in sample spacings: about one sample each
HIDDEN_RATIO, HIDDEN_M = 1.15, 0.3  # a point farther than this beyond the nearest is hidden


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud without the vehicle's own returns.

    Attributes:
        points_lidar_m: (n, 3) in the LiDAR frame.
        rank: (n,) intensity ranks in (0, 1], free of the sensor's scale; all alike without
            intensities.
    """

    points_lidar_m: Array
    rank: Array

    @staticmethod
    def of(cloud: NDArray[np.float32]) -> Cloud:
        """Prepare a cloud, (n, 4) x y z [m] and intensity (NaN where there is none)."""
        points = cloud[:, :3].astype(np.float64)
        far = np.linalg.norm(points, axis=1) > MIN_RANGE_M
        intensity = np.nan_to_num(cloud[far, 3].astype(np.float64))
        return Cloud(points[far], rankdata(intensity) / max(1, len(intensity)))


@dataclass(frozen=True, eq=False)
class Windows:
    """Correlation windows of one cloud in one view.

    Attributes:
        points_lidar_m: (p, 3) the points that windows are made of, in the LiDAR frame.
        members: (w, WINDOW_POINTS) indices into the points, the window's centre first.
        counts: (w,) how many of the members are in use: the first ones.
        basis: (w, WINDOW_POINTS, 4) columns: inverse range and intensity (orthonormal, shrunk where
            they are flat), and the two linear functions of direction.
    """

    points_lidar_m: Array
    members: NDArray[np.int32]
    counts: NDArray[np.int32]
    basis: NDArray[np.float32]


def view_angles(points_camera_m: Array) -> Array:
    """(n, 2) angles [rad] to the right of, and below, the camera's axis; for any field of view."""
    x, y, z = points_camera_m.T
    return np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])


def build_windows(cloud: Cloud, camera: Camera, level: Level, most: int) -> Windows:
    """Make at most ``most`` windows of nearest directions, as the camera at its pose sees them."""
    T = camera.T_camera_lidar
    points = cloud.points_lidar_m @ T[:3, :3].T + T[:3, 3]
    pixels, valid = camera.lens.project(points)
    index = np.flatnonzero(valid & camera.in_image(pixels))
    clear = unoccluded(points[index], OCCLUSION_SPACINGS * level.spacing_rad)
    if not level.strict:
        index, clear = index[clear], clear[clear]
    kept = thin(view_angles(points[index]), level.spacing_rad)
    index, clear = index[kept], clear[kept]
    distance = np.linalg.norm(points[index], axis=1)
    directions = points[index] / distance[:, None]
    seeds = thin(view_angles(points[index]), level.stride_spacings * level.spacing_rad)
    if len(seeds) > most:
        seeds = np.random.default_rng(0).permutation(seeds)[:most]
    members, used = _neighbours(directions, seeds, level.spacing_rad)
    trend = _trend(directions[members], used)
    basis, texture = _basis(distance[members], cloud.rank[index][members], used, trend)
    good = (used.sum(axis=1) >= MIN_WINDOW_POINTS) & (texture > MIN_TEXTURE)
    good &= clear[members].all(axis=1)
    return Windows(
        cloud.points_lidar_m[index],
        members[good].astype(np.int32),
        used[good].sum(axis=1).astype(np.int32),
        basis[good],
    )


def thin(angles: Array, cell_rad: float) -> Rows:
    """Rows of the angles (n, 2) nearest to the centre of each cell: one per cell, in any order."""
    if not len(angles):
        return np.empty(0, np.intp)
    cells = np.floor(angles / cell_rad)
    off = ((angles / cell_rad - cells - 0.5) ** 2).sum(axis=1)
    column, row = (cells - cells.min(axis=0)).astype(np.int64).T
    name = row * (column.max() + 1) + column
    order = np.lexsort((off, name))
    return np.asarray(order[np.append(True, np.diff(name[order]) != 0)])


def unoccluded(points_camera_m: Array, cell_rad: float) -> Mask:
    """Which points (n, 3) have no clearly nearer neighbour in the same cell of the view."""
    if not len(points_camera_m):
        return np.empty(0, np.bool_)
    distance = np.linalg.norm(points_camera_m, axis=1)
    angles = view_angles(points_camera_m) / cell_rad
    cells = np.floor(angles - angles.min(axis=0)).astype(np.int64)
    name = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    nearest = np.full(int(name.max()) + 1, np.inf)
    np.minimum.at(nearest, name, distance)
    return np.asarray(distance < HIDDEN_RATIO * nearest[name] + HIDDEN_M)


def _neighbours(directions: Array, seeds: Rows, spacing_rad: float) -> tuple[Rows, Mask]:
    """The nearest directions of each seed: (w, WINDOW_POINTS) indices, and which are in reach."""
    if not len(seeds):
        empty = np.empty((0, WINDOW_POINTS))
        return empty.astype(np.intp), empty.astype(np.bool_)
    even = np.sqrt(WINDOW_POINTS / np.pi) * max(spacing_rad, MIN_SPACING_RAD)
    gaps, members = cKDTree(directions).query(
        directions[seeds], WINDOW_POINTS, distance_upper_bound=WINDOW_STRETCH * even
    )
    used = np.isfinite(gaps)
    return np.where(used, members, members[:, :1]), used


def _trend(directions: Array, used: Mask) -> Array:
    """(w, l, 2) orthonormal basis of the linear functions of direction in each window.

    Inverse range is linear in direction on any plane, and shading mostly so: without these parts
    only edges and markings are left to match.
    """
    count = np.maximum(used.sum(axis=1), 1)[:, None, None]
    mean = (directions * used[..., None]).sum(axis=1, keepdims=True) / count
    off = (directions - mean) * used[..., None]
    values, vectors = np.linalg.eigh(np.einsum("wli,wlj->wij", off, off))
    axes = vectors[:, :, 1:]  # the smallest is the line of sight
    good = values[:, 1:] > 1e-3 * values[:, 2:]  # a single scan line spans one direction only
    scale = np.where(good, 1 / np.sqrt(np.where(good, values[:, 1:], 1.0)), 0.0)
    return np.asarray(np.einsum("wli,wik,wk->wlk", off, axes, scale))


def _basis(
    distance: Array, rank: Array, used: Mask, trend: Array
) -> tuple[NDArray[np.float32], Array]:
    """Centre and orthonormalise inverse range and intensity, shrunk where they are flat.

    Inverse range comes first: the part that it shares with the intensity has no reliable sign.

    Returns:
        (w, l, 4) basis: inverse range, intensity, trend; (w,) the larger of both reliabilities.
    """
    count = np.maximum(used.sum(axis=1, keepdims=True), 1)
    inverse = 1.0 / distance
    inverse /= (inverse * used).sum(axis=1, keepdims=True) / count
    columns: list[Array] = []
    weights: list[Array] = []
    for values, noise in ((inverse, DEPTH_NOISE), (rank, INTENSITY_NOISE)):
        column = _detrended(values, used, count, trend)
        for other in columns:
            column = column - other * (column * other).sum(axis=1, keepdims=True)
        power = (column**2).sum(axis=1, keepdims=True)
        columns.append(column / np.sqrt(power + 1e-12))
        weights.append(np.sqrt(power / (power + count * noise**2)))
    shrunk = [column * weight for column, weight in zip(columns, weights, strict=True)]
    basis = np.concatenate([np.stack(shrunk, axis=2), trend], axis=2)
    return basis.astype(np.float32), np.maximum(*weights)[:, 0]


def _detrended(values: Array, used: Mask, count: NDArray[np.intp], trend: Array) -> Array:
    """Values (w, l) without their mean and their linear part."""
    mean = (values * used).sum(axis=1, keepdims=True) / count
    centred = (values - mean) * used
    linear = np.einsum("wli,wl->wi", trend, centred)
    return np.asarray(centred - np.einsum("wli,wi->wl", trend, linear))
