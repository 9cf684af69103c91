"""LiDAR windows: neighbourhoods of rays, what varies in them, and where it is to be seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from calibgraph.matching.structure.schedule import Level
from calibgraph.model.geometry import camera_center
from calibgraph.model.rig import Camera

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
ORIGIN_CELL_RAD, MAX_HIDDEN_FROM_ORIGIN = np.radians(0.3), 0.04
"""Share of points that others hide: seen from a sensor 0.1 to 2.7 %, from a vehicle's base frame
34 %."""

SILHOUETTE_SHARE, SILHOUETTE_RATIO = 0.5, 1.25
MAX_COVERED = 0.3  # share of a window that something nearer may cover where accuracy can wait
OCCLUSION_SPACINGS = 1.5  # occlusion cell in sample spacings: about one sample each
HIDDEN_RATIO, HIDDEN_M = 1.15, 0.3  # a point farther than this beyond the nearest is hidden


@dataclass(frozen=True, eq=False)
class Cloud:
    """A cloud without the vehicle's own returns.

    Attributes:
        points_lidar_m: (n, 3) in the LiDAR frame.
        rank: (n,) intensity ranks in (0, 1], free of the sensor's scale; all alike without
            intensities.
        from_origin: whether it was seen from the LiDAR frame's origin: the clouds of several
            sensors together, or in a vehicle's frame, are not.
    """

    points_lidar_m: Array
    rank: Array
    from_origin: bool

    @staticmethod
    def of(cloud: NDArray[np.float32]) -> Cloud:
        """Prepare a cloud, (n, 4) x y z [m] and intensity (NaN where there is none)."""
        points = cloud[:, :3].astype(np.float64)
        distance = np.linalg.norm(points, axis=1)
        far = distance > MIN_RANGE_M
        points, distance = points[far], distance[far]
        intensity = np.nan_to_num(cloud[far, 3].astype(np.float64))
        hidden = ~unoccluded(scan_angles(points), distance, ORIGIN_CELL_RAD)
        return Cloud(
            points,
            rankdata(intensity) / max(1, len(intensity)),
            from_origin=bool(hidden.sum() <= MAX_HIDDEN_FROM_ORIGIN * len(hidden)),
        )

    def viewpoint_m(self, camera: Camera) -> Array:
        """(3,) from where its windows are seen: the sensor if that is known, else the camera."""
        T = camera.T_camera_lidar
        return np.zeros(3) if self.from_origin else camera_center(T)


@dataclass(frozen=True, eq=False)
class Windows:
    """Correlation windows of one cloud.

    Attributes:
        rays_m: (w, WINDOW_POINTS, 3) from the viewpoint, along the axes of the LiDAR frame, to
            the points, the window's centre first. What lies behind a silhouette is drawn forward
            to it, along its ray: where a silhouette is in an image depends on its own distance.
        members: (w, WINDOW_POINTS) the same points, as indices into those that were given.
        front: (w, WINDOW_POINTS) which of them are not behind a silhouette.
        counts: (w,) how many of the members are in use: the first ones.
        basis: (w, WINDOW_POINTS, 4) columns: inverse range and intensity (orthonormal, shrunk where
            they are flat), and the two linear functions of direction; these are zero where a
            window keeps its linear parts.
    """

    rays_m: Array
    members: Rows
    front: Mask
    counts: NDArray[np.int32]
    basis: NDArray[np.float32]

    def of(self, rows: Mask) -> Windows:
        """Some of the windows."""
        return Windows(**{name: values[rows] for name, values in vars(self).items()})


def view_angles(points_camera_m: Array) -> Array:
    """(n, 2) angles [rad] to the right of, and below, the camera's axis; for any field of view."""
    x, y, z = points_camera_m.T
    return np.column_stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))])


def build_windows(cloud: Cloud, camera: Camera, level: Level, most: int) -> Windows:
    """Make at most ``most`` windows of what the camera at its pose sees of a cloud."""
    T = camera.T_camera_lidar
    points = cloud.points_lidar_m @ T[:3, :3].T + T[:3, 3]
    pixels, valid = camera.lens.project(points)
    index = np.flatnonzero(valid & camera.in_image(pixels))
    angles, distance = view_angles(points[index]), np.linalg.norm(points[index], axis=1)
    clear = unoccluded(angles, distance, OCCLUSION_SPACINGS * level.spacing_rad)
    if not (level.strict or cloud.from_origin):
        index, clear = index[clear], clear[clear]
    rays_m = cloud.points_lidar_m - cloud.viewpoint_m(camera)
    kept = thin(scan_angles(rays_m[index]), level.spacing_rad)
    index, clear = index[kept], clear[kept]
    windows = cut_windows(
        rays_m[index],
        cloud.rank[index],
        spacing_rad=level.spacing_rad,
        stride_spacings=level.stride_spacings,
        most=most,
        keep_linear=level.strict,
    )
    covered = (windows.front & ~clear[windows.members]).mean(axis=1)
    return windows.of(covered <= (0.0 if level.strict else MAX_COVERED))


def cut_windows(
    rays_m: Array,
    rank: Array,
    *,
    spacing_rad: float,
    stride_spacings: float,
    most: int,
    keep_linear: bool,
    seed: int = 0,
) -> Windows:
    """Make at most ``most`` windows of nearest rays, those that have something in them.

    Args:
        rays_m: (n, 3) from the viewpoint to thinned points.
        rank: (n,) their intensity ranks.
        spacing_rad: of the points.
        stride_spacings: of the windows, in spacings of the points.
        most: windows.
        keep_linear: do not take the linear parts out of what varies.
        seed: of their choice, if there are more.
    """
    ranges = np.linalg.norm(rays_m, axis=1)
    rays, angles = rays_m / ranges[:, None], scan_angles(rays_m)
    seeds = thin(angles, stride_spacings * spacing_rad)
    if len(seeds) > most:
        seeds = np.random.default_rng(seed).permutation(seeds)[:most]
    members, used = _neighbours(angles, seeds, spacing_rad)
    trend = _no_trend(used) if keep_linear else _trend(rays[members], used)
    basis, texture = _basis(ranges[members], rank[members], used, trend)
    front, drawn = _drawn_forward(ranges[members])
    windows = Windows(
        rays_m=rays[members] * drawn[..., None],
        members=members,
        front=front,
        counts=used.sum(axis=1).astype(np.int32),
        basis=basis,
    )
    return windows.of((used.sum(axis=1) >= MIN_WINDOW_POINTS) & (texture > MIN_TEXTURE))


def _drawn_forward(ranges: Array) -> tuple[Mask, Array]:
    """Which members are not behind a silhouette, and the ranges (w, l) without what is behind.

    A silhouette is where the largest gap between a window's inverse ranges is most of what they
    span: a slope has many gaps.
    """
    inverse = 1.0 / ranges
    ordered = -np.sort(-inverse, axis=1)
    gaps = ordered[:, :-1] - ordered[:, 1:]
    widest = gaps.argmax(axis=1)[:, None]
    near = np.take_along_axis(ordered, widest, axis=1)
    far = np.take_along_axis(ordered, widest + 1, axis=1)
    span = ordered[:, :1] - ordered[:, -1:]
    silhouette = (near - far > SILHOUETTE_SHARE * span) & (near > SILHOUETTE_RATIO * far)
    front = ~silhouette | (inverse >= near)
    return front, np.where(front, ranges, 1.0 / near)


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


def unoccluded(angles: Array, distance: Array, cell_rad: float) -> Mask:
    """Which points, by angles (n, 2) and distance (n,), have no much nearer one in their cell."""
    if not len(angles):
        return np.empty(0, np.bool_)
    cells = np.floor((angles - angles.min(axis=0)) / cell_rad).astype(np.int64)
    name = cells[:, 0] * (cells[:, 1].max() + 1) + cells[:, 1]
    nearest = np.full(int(name.max()) + 1, np.inf)
    np.minimum.at(nearest, name, distance)
    return np.asarray(distance < HIDDEN_RATIO * nearest[name] + HIDDEN_M)


def scan_angles(rays_m: Array) -> Array:
    """(n, 2) angles along and across scan lines about the LiDAR's z axis, from their middle."""
    if not len(rays_m):
        return np.empty((0, 2))
    x, y, z = rays_m.T
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    middle = np.arctan2(np.sin(azimuth).sum(), np.cos(azimuth).sum())
    along = (azimuth - middle + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([along * np.cos(elevation), elevation])


def _neighbours(angles: Array, seeds: Rows, spacing_rad: float) -> tuple[Rows, Mask]:
    """The nearest points of each seed by scan angles (n, 2).

    Returns:
        (w, WINDOW_POINTS) indices, and which of them are in reach; the seed instead of the others.
    """
    if not len(seeds):
        empty = np.empty((0, WINDOW_POINTS))
        return empty.astype(np.intp), empty.astype(np.bool_)
    even = np.sqrt(WINDOW_POINTS / np.pi) * max(spacing_rad, MIN_SPACING_RAD)
    gaps, members = cKDTree(angles).query(
        angles[seeds], WINDOW_POINTS, distance_upper_bound=WINDOW_STRETCH * even
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


def _no_trend(used: Mask) -> Array:
    """(w, l, 2) zeros, in place of the linear functions of direction: no part is taken out."""
    return np.zeros((*used.shape, 2))


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
