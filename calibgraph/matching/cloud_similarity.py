"""Whether two clouds show the same place, and the motion between them, from the clouds alone.

Upright structure is drawn as an image from above. The magnitude of its spectrum is invariant to the
vehicle's position, so a correlation along its polar angle gives the heading (Fourier-Mellin), then
one of the images the offset. ICP refines it, and upright points of both clouds must coincide.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.model.geometry import invert, transform

LEAST_OVERLAP = 0.5
"""Of the upright points of either cloud, the share that must be within _NEAR_M of the other's. In
two rendered streets (seeds 3 and 4, driven both ways) all 354 pairs of scans within 10 m have more,
91 % of the 737 within 20 m, and none of the 850 that are over 30 m apart."""
LEAST_CORRELATION = 0.42
"""Of the images from above, for the points to be looked at. All of the same pairs within 20 m have
more; of different sequences of KITTI one pair in a hundred has."""

LEAST_UPRIGHT = 500
"""Upright points that a cloud needs for its unlikeness to mean another place. Of 13 recordings the
poorest, of 16 beams in a hall, has 755 a cloud. All of their 214 pairs within one place are found
alike, with overlaps from 0.73; none of 83 pairs of 25 places of KITTI 00 is, with up to 0.46."""

_CELLS, _CELL_M, _REACH_M = 128, 1.0, 48.0  # so much wider that offsets up to 32 m do not wrap
_VOXEL_M, _HEIGHT_M = 0.5, 20.0
_MOST_POINTS = 40_000  # of a cloud, chosen at random: more show no more in such voxels
_LEAST_RANGE_M = 2.5  # nearer points are of the vehicle
_UPRIGHT_M, _ABOVE_GROUND_M = 0.5, 0.3
_MOST_VOXELS = 12  # of a cell that count: higher things are no surer
_GRID = _CELLS, _CELL_M, _MOST_VOXELS
_ANGLES, _RADII = 120, np.linspace(3.0, 40.0, 32)  # of the spectrum; an angle is 1.5 degrees
_LIKELY, _VERIFIED = 32, 4  # places whose images, and points, are compared
_ICP_STEPS, _FIRST_GATE_M, _GATE_SHRINKS, _LAST_GATE_M = 10, 3.0, 0.7, 0.6
_ICP_POINTS, _OVERLAP_POINTS = 500, 1000  # that are compared, of a cloud
_NEAR_M, _COMMON_M = 0.5, 35.0  # points farther from either LiDAR are not expected in both clouds
_MIN_POINTS = 100
_TINY = float(np.finfo(np.float64).tiny)


Z_UP: Array = np.eye(3)
_SURE_UP = 0.5
"""Mean of the cameras' unit vectors up: shorter, they are not up."""
_NEAR_UP, _GROUND_NEAR_UP = np.cos(np.radians([45.0, 30.0]))
_LEAST_GROUND, _MORE_GROUND = 0.1, 1.5
"""Least share of the points on a ground, and how many times more than across the other direction.
Of 18 recordings the ground has 0.13 to 0.75 along z, and at most 0.12 upside down. Along the other
axes it has 0.01, but for walls near the LiDAR, 0.18 and 0.22: of these only the cameras' up is
tried."""
_GROUND_M, _BELOW_M, _SENSOR_M = 0.1, 0.3, (0.2, 5.0)  # of a plane, below it, of the LiDAR above it
_GROUND_REACH_M, _MOST_BELOW = 15.0, 0.03
_TRIPLES, _GROUND_POINTS = 1000, 2000
_LOWEST = 0.3  # of the points on the plane that holds most; planes that are neither have up to 0.15
_UPS = np.array([up for up in product((-1.0, 0.0, 1.0), repeat=3) if any(up)])


def find_up(cloud: NDArray[np.floating], cameras: Iterable[Array]) -> Array | None:
    """Which way is up in a cloud.

    The LiDAR's z, unless the cameras' up is over 45 deg from it: then the one of both that is
    normal to a ground, by far more points than the other.

    Args:
        cloud: (n, 3) or more columns [m].
        cameras: (4, 4) T_camera_lidar of each.

    Returns:
        (3, 3) R_up_lidar, from the cloud's axes to some with z up; None if it is unknown.
    """
    up = -np.mean([T[1, :3] for T in cameras], axis=0)
    length = float(np.linalg.norm(up))
    if length > _SURE_UP and up[2] > _NEAR_UP * length:
        return Z_UP
    directions = [Z_UP[2], up / max(length, _TINY)][: 1 + (length > _SURE_UP)]
    grounds = [find_ground(cloud, direction) for direction in directions]
    best = max(grounds, key=lambda ground: ground[0])
    rival = max((ground[0] for ground in grounds if ground is not best), default=0.0)
    if best[0] < max(_LEAST_GROUND, _MORE_GROUND * rival):
        return None
    if best is grounds[0]:
        return Z_UP
    return np.asarray(Rotation.align_vectors(Z_UP[2:], best[2][None])[0].as_matrix())


def find_ground(cloud: NDArray[np.floating], up: Array) -> tuple[float, float, Array]:
    """The plane across a direction with most points on it, hardly any below and the LiDAR above.

    Returns:
        The share of the points near the LiDAR that lie on it, the height of the LiDAR [m] over it,
        and its (3,) normal.
    """
    rng = np.random.default_rng(0)
    ranges = np.linalg.norm(cloud[:, :3], axis=1)
    near = cloud[(ranges > _LEAST_RANGE_M) & (ranges < _GROUND_REACH_M), :3].astype(np.float64)
    if len(near) < _MIN_POINTS:
        return 0.0, 0.0, up
    points = near[rng.integers(len(near), size=_GROUND_POINTS)]
    a, b, c = points[rng.integers(len(points), size=(3, _TRIPLES))]
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), _TINY)
    normal *= np.sign(normal @ up)[:, None]
    height_m = -np.einsum("ni,ni->n", normal, a)  # of the LiDAR
    possible = (normal @ up > _GROUND_NEAR_UP) & (height_m > _SENSOR_M[0])
    possible &= height_m < _SENSOR_M[1]
    heights = normal[possible] @ points.T + height_m[possible, None]
    on_it = (np.abs(heights) < _GROUND_M).mean(axis=1)
    on_it[(heights < -_BELOW_M).mean(axis=1) > _MOST_BELOW] = 0.0
    if not on_it.any():
        return 0.0, 0.0, up
    best = int(on_it.argmax())
    return float(on_it[best]), float(height_m[possible][best]), normal[possible][best]


def find_upright(name: str, clouds: Sequence[Array]) -> Array:
    """(4, 4) T_up_lidar: z up, 0 on the ground; by all instants together.

    In a narrow street a wall may hold more points than the ground, but the ground is nearer.
    """
    cloud = np.concatenate(clouds)
    grounds = [find_ground(cloud, up / np.linalg.norm(up)) for up in _UPS]
    most = max(share for share, _, _ in grounds)
    _, height_m, normal = min(
        (ground for ground in grounds if ground[0] >= _LOWEST * most), key=lambda ground: ground[1]
    )
    if most == 0.0:
        raise CalibrationError(
            f"LiDAR {name!r} sees no ground, by which its placement is found; write its "
            "T_base_lidar into rig.yaml"
        )
    turn, _ = Rotation.align_vectors(Z_UP[2:], normal[None])
    return transform(turn, [0.0, 0.0, height_m])


@dataclass(frozen=True, eq=False)
class UprightCloud:
    """The upright things of a cloud, as points and from above.

    Attributes:
        points_m: (n, 3) float32 in the LiDAR's axes turned until z is up, one per voxel.
        spectrum: (_CELLS, _CELLS / 2 + 1) complex64 of the image from above, of unit norm.
        polar: (_ANGLES / 2 + 1, r) complex64 spectrum, along the angle, of the polar image of
            the magnitude of that spectrum; of unit norm.
    """

    points_m: NDArray[np.float32]
    spectrum: NDArray[np.complex64]
    polar: NDArray[np.complex64]

    @staticmethod
    def from_cloud(cloud: NDArray[np.floating], R_up_lidar: Array = Z_UP) -> UprightCloud:
        """Extract upright structure from a cloud.

        Args:
            cloud: (n, 3) or more columns [m].
            R_up_lidar: (3, 3) from its axes to some with z up.
        """
        chosen = np.random.default_rng(0).random(len(cloud)) * len(cloud) < _MOST_POINTS
        points = np.asarray(cloud[chosen, :3], dtype=np.float64)
        points = _upright_points(points @ R_up_lidar.T)
        image = image_from_above(points, *_GRID)
        magnitude = np.fft.fftshift(np.abs(np.fft.fft2(image))).astype(np.float32)
        angle = np.arange(_ANGLES)[:, None] * (np.pi / _ANGLES)
        row, column = (_CELLS / 2 + _RADII * f(angle) for f in (np.cos, np.sin))
        maps = column.astype(np.float32), row.astype(np.float32)
        polar = np.asarray(cv2.remap(np.sqrt(magnitude), *maps, cv2.INTER_LINEAR), np.float64)
        polar -= polar.mean(axis=0)
        polar = polar / max(float(np.linalg.norm(polar)), _TINY)
        return UprightCloud(
            points.astype(np.float32),
            np.fft.rfft2(image).astype(np.complex64),
            np.fft.rfft(polar, axis=0).astype(np.complex64),
        )

    @property
    def nbytes(self) -> int:
        """Size in memory, without the tree."""
        return self.points_m.nbytes + self.spectrum.nbytes + self.polar.nbytes

    @cached_property
    def tree(self) -> cKDTree:
        """Of the points."""
        return cKDTree(self.points_m)


def align_with_any(now: UprightCloud, known: Sequence[UprightCloud]) -> tuple[int, Array] | None:
    """Which of some clouds shows the place of another one best, and the motion between them.

    Returns:
        The row of the most similar of them, and (4, 4) T_now_known of the LiDAR; None if they show
        other places. Of clouds within 10 m nearly all are found, beyond 20 m half of them.
    """
    if not known:
        return None
    products = np.stack([each.polar for each in known]) * now.polar.conj()
    turns = np.fft.irfft(products.sum(axis=2), _ANGLES, axis=1)
    likely = np.argsort(-turns.max(axis=1), kind="stable")[:_LIKELY]
    starts = {int(row): _correlate(known[row], now, int(turns[row].argmax())) for row in likely}
    similar = [row for row in starts if starts[row][0] > LEAST_CORRELATION]
    for row in sorted(similar, key=lambda row: -starts[row][0])[:_VERIFIED]:
        T_known_now = _refine(known[row], now, starts[row][1])
        if T_known_now is None:
            continue
        T_now_known = invert(T_known_now)
        shares = _share(known[row], now, T_known_now), _share(now, known[row], T_now_known)
        if min(shares) > LEAST_OVERLAP:
            return row, T_now_known
    return None


def _upright_points(points: Array) -> Array:
    """Points above the ground in cells with points at several heights, one per voxel."""
    ranges = np.hypot(points[:, 0], points[:, 1])
    near = (ranges > _LEAST_RANGE_M) & (ranges < _REACH_M) & (np.abs(points[:, 2]) < _HEIGHT_M)
    points = points[near]
    i, j = np.floor(points[:, :2] / _CELL_M).astype(np.int64).T + _CELLS // 2
    cell, z = i * _CELLS + j, points[:, 2]
    low, high = np.full(_CELLS**2, np.inf), np.full(_CELLS**2, -np.inf)
    np.minimum.at(low, cell, z)
    np.maximum.at(high, cell, z)
    upright = ((high - low)[cell] > _UPRIGHT_M) & (z > low[cell] + _ABOVE_GROUND_M)
    points = points[upright]
    i, j, k = np.floor((points + _REACH_M) / _VOXEL_M).astype(np.int64).T
    side = round(2 * _REACH_M / _VOXEL_M)
    return points[np.unique((i * side + j) * side + k, return_index=True)[1]]


def image_from_above(points: Array, cells: int, cell_m: float, most: float = np.inf) -> Array:
    """(cells, cells) how much is in each cell, blurred, of mean 0 and unit norm.

    More than so many points of a cell count no more.
    """
    i, j = np.floor(points[:, :2] / cell_m).astype(np.int64).T + cells // 2
    inside = (i >= 0) & (i < cells) & (j >= 0) & (j < cells)
    counts = np.bincount(i[inside] * cells + j[inside], minlength=cells**2).astype(np.float64)
    image = np.sqrt(np.minimum(counts, most)).reshape(cells, cells)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), dtype=np.float64)
    image -= image.mean()
    return np.asarray(image / max(cv2.norm(image), _TINY))


def _correlate(known: UprightCloud, now: UprightCloud, turn: int) -> tuple[float, Array]:
    """The best correlation of two images from above, and (4, 4) T_known_now there."""
    best, T_best = -1.0, np.eye(4)
    for angle in (turn * np.pi / _ANGLES, turn * np.pi / _ANGLES + np.pi):
        T = np.eye(4)
        T[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        turned = np.fft.rfft2(image_from_above(now.points_m @ T[:3, :3].T, *_GRID))
        correlation = np.fft.irfft2(known.spectrum * turned.conj())
        offset = np.array(np.unravel_index(correlation.argmax(), correlation.shape))
        if correlation.max() > best:
            best, T_best = float(correlation.max()), T
            T_best[:2, 3] = _CELL_M * ((offset + _CELLS // 2) % _CELLS - _CELLS // 2)
    return best, T_best


def _refine(known: UprightCloud, now: UprightCloud, T_known_now: Array) -> Array | None:
    """(4, 4) T_known_now by ICP, point to point; None if too few points are near each other."""
    T, gate = T_known_now, _FIRST_GATE_M
    points = _some(now.points_m, _ICP_POINTS)
    for _ in range(_ICP_STEPS):
        moved = points @ T[:3, :3].T + T[:3, 3]
        distance, row = known.tree.query(moved, distance_upper_bound=gate)
        near = np.isfinite(distance)
        if np.count_nonzero(near) < _MIN_POINTS:
            return None
        T = _rigid_fit(moved[near], known.points_m[row[near]].astype(np.float64)) @ T
        gate = max(_LAST_GATE_M, _GATE_SHRINKS * gate)
    return T


def _rigid_fit(source: Array, target: Array) -> Array:
    """(4, 4) that moves (n, 3) points onto others, least squares (Kabsch, 1976)."""
    before, after = source.mean(axis=0), target.mean(axis=0)
    turn, _ = Rotation.align_vectors(target - after, source - before)
    return transform(turn, after - turn.apply(before))


def _share(target: UprightCloud, source: UprightCloud, T_target_source: Array) -> float:
    """The share of one cloud's points that are near one of the other's."""
    moved = source.points_m @ T_target_source[:3, :3].T + T_target_source[:3, 3]
    both = [np.hypot(p[:, 0], p[:, 1]) < _COMMON_M for p in (moved, source.points_m)]
    moved = _some(moved[both[0] & both[1]], _OVERLAP_POINTS)
    if len(moved) < _MIN_POINTS:
        return 0.0
    distance, _ = target.tree.query(moved, distance_upper_bound=_NEAR_M)
    return float(np.isfinite(distance).mean())


def _some(points: NDArray[np.floating], most: int) -> Array:
    """An evenly spread selection of (n, 3) points."""
    rows = np.linspace(0, len(points) - 1, min(most, len(points)))
    return points[rows.astype(np.intp)].astype(np.float64)
