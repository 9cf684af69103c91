"""LiDAR windows: neighbourhoods of rays, with the variation to look for in the image.

A window is a LiDAR point with its nearest rays. Its basis holds how inverse range and intensity
vary over these rays: :mod:`calibgraph.matching.structure.shift_scores` correlates the image with
it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.matching.structure.directions import find_visible, scan_angles, thin, view_angles
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.schedule import Level
from calibgraph.model.rig import Camera

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Mask = NDArray[np.bool_]

WINDOW_POINTS = 25  # samples of a window; fewer cannot hold an edge and both its sides
MIN_WINDOW_POINTS = 9
WINDOW_STRETCH = 4.0  # longest window by the radius of an even one: room for single scan lines
MIN_SPACING_RAD = np.radians(0.15)  # few sensors sample more finely along their scan lines
INTENSITY_NOISE = 0.05  # of intensity ranks: below, a window counts as flat
DEPTH_NOISE = 0.03  # of relative inverse range: below, a window counts as flat
MIN_RELIABILITY = 0.3  # of a window's variation (0 flat, 1 strong)
SILHOUETTE_SHARE, SILHOUETTE_RATIO = 0.5, 1.25
MAX_COVERED = 0.3  # share of a window that something nearer may cover at a coarse level
OCCLUSION_SPACINGS = 1.5  # occlusion cell in sample spacings: about one sample each


@dataclass(frozen=True, eq=False)
class Windows:
    """Correlation windows of one cloud.

    Attributes:
        rays_m: (w, WINDOW_POINTS, 3) from the viewpoint, along the axes of the LiDAR frame, to
            the points, the window's centre first. Points behind a silhouette are moved along
            their rays to its distance, which determines where the silhouette is in the image.
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

    def select(self, rows: Mask | Rows) -> Windows:
        """Some of the windows."""
        return Windows(**{name: values[rows] for name, values in vars(self).items()})


def build_windows(
    cloud: PreparedCloud, camera: Camera, level: Level, *, max_windows: int
) -> Windows:
    """Cut windows from the part of a cloud that the camera sees from its estimated pose."""
    T = camera.T_camera_lidar
    points = cloud.points_lidar_m @ T[:3, :3].T + T[:3, 3]
    pixels, valid = camera.lens.project(points)
    index = np.flatnonzero(valid & camera.in_image(pixels))
    angles, distance_m = view_angles(points[index]), np.linalg.norm(points[index], axis=1)
    visible = find_visible(angles, distance_m, OCCLUSION_SPACINGS * level.spacing_rad)
    if not (level.fine or cloud.seen_from_origin):
        index, visible = index[visible], visible[visible]
    rays_m = cloud.points_lidar_m - cloud.viewpoint_lidar_m(camera)
    kept = thin(scan_angles(rays_m[index]), level.spacing_rad)
    index, visible = index[kept], visible[kept]
    windows = cut_windows(
        rays_m[index],
        cloud.intensity_rank[index],
        spacing_rad=level.spacing_rad,
        stride_spacings=level.stride_spacings,
        max_windows=max_windows,
        keep_linear=level.fine,
    )
    covered = (windows.front & ~visible[windows.members]).mean(axis=1)
    return windows.select(covered <= (0.0 if level.fine else MAX_COVERED))


def cut_windows(
    rays_m: Array,
    intensity_rank: Array,
    *,
    spacing_rad: float,
    stride_spacings: float,
    max_windows: int,
    keep_linear: bool,
    seed: int = 0,
) -> Windows:
    """Cut windows of nearest rays, and keep those in which something varies.

    Args:
        rays_m: (n, 3) from the viewpoint to thinned points, along the axes of the LiDAR frame.
        intensity_rank: (n,) of the points.
        spacing_rad: of the points.
        stride_spacings: of the windows, in spacings of the points.
        max_windows: at most so many, drawn at random.
        keep_linear: keep the linear parts of the variation.
        seed: of the draw.
    """
    ranges_m = np.linalg.norm(rays_m, axis=1)
    rays, angles = rays_m / ranges_m[:, None], scan_angles(rays_m)
    centres = thin(angles, stride_spacings * spacing_rad)
    if len(centres) > max_windows:
        centres = np.random.default_rng(seed).permutation(centres)[:max_windows]
    members, used = _nearest_rays(angles, centres, spacing_rad)
    trend = np.zeros((*used.shape, 2)) if keep_linear else _linear_basis(rays[members], used)
    basis, reliability = _window_basis(ranges_m[members], intensity_rank[members], used, trend)
    front, moved_m = _move_to_silhouettes(ranges_m[members])
    windows = Windows(
        rays_m=rays[members] * moved_m[..., None],
        members=members,
        front=front,
        counts=used.sum(axis=1).astype(np.int32),
        basis=basis,
    )
    return windows.select((used.sum(axis=1) >= MIN_WINDOW_POINTS) & (reliability > MIN_RELIABILITY))


def _nearest_rays(angles: Array, centres: Rows, spacing_rad: float) -> tuple[Rows, Mask]:
    """The nearest rays of each centre, by scan angles (n, 2).

    Returns:
        (w, WINDOW_POINTS) indices, and which of them are in reach; the centre instead of others.
    """
    if not len(centres):
        empty = np.empty((0, WINDOW_POINTS))
        return empty.astype(np.intp), empty.astype(np.bool_)
    even = np.sqrt(WINDOW_POINTS / np.pi) * max(spacing_rad, MIN_SPACING_RAD)
    gaps, members = cKDTree(angles).query(
        angles[centres], WINDOW_POINTS, distance_upper_bound=WINDOW_STRETCH * even
    )
    used = np.isfinite(gaps)
    return np.where(used, members, members[:, :1]), used


def _move_to_silhouettes(ranges_m: Array) -> tuple[Mask, Array]:
    """Move the members behind a silhouette to its distance.

    A silhouette is where the largest gap between a window's inverse ranges is most of what they
    span: a slope has many gaps.

    Returns:
        (w, l) which members are not behind a silhouette; (w, l) the ranges after the move [m].
    """
    inverse = 1.0 / ranges_m
    ordered = -np.sort(-inverse, axis=1)
    gaps = ordered[:, :-1] - ordered[:, 1:]
    widest = gaps.argmax(axis=1)[:, None]
    near = np.take_along_axis(ordered, widest, axis=1)
    far = np.take_along_axis(ordered, widest + 1, axis=1)
    span = ordered[:, :1] - ordered[:, -1:]
    silhouette = (near - far > SILHOUETTE_SHARE * span) & (near > SILHOUETTE_RATIO * far)
    front = ~silhouette | (inverse >= near)
    return front, np.where(front, ranges_m, 1.0 / near)


def _linear_basis(directions: Array, used: Mask) -> Array:
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


def _window_basis(
    ranges_m: Array, intensity_rank: Array, used: Mask, trend: Array
) -> tuple[NDArray[np.float32], Array]:
    """Centre and orthonormalise inverse range and intensity, shrunk where they are flat.

    Inverse range comes first: the part that it shares with the intensity has no reliable sign.

    Returns:
        (w, l, 4) basis: inverse range, intensity, trend; (w,) the larger of both reliabilities.
    """
    count = np.maximum(used.sum(axis=1, keepdims=True), 1)
    inverse = 1.0 / ranges_m
    inverse /= (inverse * used).sum(axis=1, keepdims=True) / count
    columns: list[Array] = []
    weights: list[Array] = []
    for values, noise in ((inverse, DEPTH_NOISE), (intensity_rank, INTENSITY_NOISE)):
        column = _detrend(values, used, count, trend)
        for other in columns:
            column = column - other * (column * other).sum(axis=1, keepdims=True)
        power = (column**2).sum(axis=1, keepdims=True)
        columns.append(column / np.sqrt(power + 1e-12))
        weights.append(np.sqrt(power / (power + count * noise**2)))
    shrunk = [column * weight for column, weight in zip(columns, weights, strict=True)]
    basis = np.concatenate([np.stack(shrunk, axis=2), trend], axis=2)
    return basis.astype(np.float32), np.maximum(*weights)[:, 0]


def _detrend(values: Array, used: Mask, count: NDArray[np.intp], trend: Array) -> Array:
    """Subtract the mean and the linear part from values (w, l)."""
    mean = (values * used).sum(axis=1, keepdims=True) / count
    centred = (values - mean) * used
    linear = np.einsum("wli,wl->wi", trend, centred)
    return np.asarray(centred - np.einsum("wli,wi->wl", trend, linear))
