"""Planes that a LiDAR's points lie on, from neighbourhoods wider than the spacing of its rings.

Points of two LiDARs never coincide, and their rings attract each other: nearest points pull a pose
towards where rings lie upon rings. The mean of points of a plane lies on that plane, wherever they
were measured, if they spread in two directions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array, name_cells
from calibgraph.model.geometry import move_points

_NEAREST_M, _FARTHEST_M = 1.0, 80.0  # the vehicle itself, and where planes are too few to match
_SHARES = (0.04, 0.08, 0.16)  # radii of neighbourhoods over the range, in turn until one spreads
_LEAST_M, _LARGEST_M = 0.3, 4.0  # of a radius
_MOST = 5000  # planes of a cloud: of more, the residuals repeat each other
_POINTS = 10  # of a plane, at least
_ASPECT = 0.15  # least variance along a plane over the largest: of a single ring it is far smaller
_SPREAD = 0.04  # of the same over the squared radius
_FLAT, _ROUGH_M = 0.01, 0.08  # most variance across a plane over the least along it; most roughness


PLANE = np.dtype([
    ("center_m", "f8", 3), ("normal", "f8", 3), ("ray", "f8", 3), ("radius_m", "f8"), ("tilt", "f8")
])  # fmt: skip
"""A piece of a plane: the mean of its points, a unit vector towards the LiDAR, one from the LiDAR
to the mean, the radius of the neighbourhood, and by how much the normal may err [rad]: roughness
over the least extent."""
Planes = NDArray[np.void]
"""(n,) of PLANE."""


def thinned(planes: Planes, most: int) -> Planes:
    """At most so many of them."""
    return planes[:: max(-(-len(planes) // most), 1)]


def moved(planes: Planes, T_base_lidar: Array) -> Planes:
    """The same in another frame, by (4, 4)."""
    found = planes.copy()
    found["center_m"] = move_points(planes["center_m"], T_base_lidar)
    for name in ("normal", "ray"):
        found[name] = planes[name] @ T_base_lidar[:3, :3].T
    return found


def lengthened(planes: Planes, metres: float) -> Planes:
    """The same as if so much were added to all ranges."""
    found = planes.copy()
    found["center_m"] += metres * planes["ray"]
    return found


class View(NamedTuple):
    """What a LiDAR sees at one instant: (n, 3) points [m], and their planes, in its frame."""

    points_m: Array
    planes: Planes

    def joined(self, other: View, T: Array) -> View:
        """With what another one sees, whose frame is at (4, 4) in this one's."""
        points = np.concatenate([self.points_m, move_points(other.points_m, T)])
        return View(points, np.concatenate([self.planes, moved(other.planes, T)]))


Views = Mapping[str, Sequence[View]]
"""Per LiDAR, one of each instant; the same instants."""


def look(clouds: Mapping[str, Sequence[Array]]) -> Views:
    """The views of clouds, (n, 3) or more columns [m]."""
    return {
        name: [View(cloud[:, :3].astype(np.float64), find_planes(cloud)) for cloud in of]
        for name, of in clouds.items()
    }


def find_planes(points_lidar_m: Array) -> Planes:
    """The planes of a cloud, (n, 3) or more columns, of which the first three are x y z.

    A neighbourhood grows with the range, and further where its points do not spread in two
    directions, as those of a ring on the ground; where they spread and are not flat, it is dropped.
    """
    points = np.asarray(points_lidar_m[:, :3], dtype=np.float64)
    ranges = np.linalg.norm(points, axis=1)
    points = points[(ranges > _NEAREST_M) & (ranges < _FARTHEST_M)]
    left, found, tree = _seeds(points), [np.empty(0, PLANE)], None
    for share in _SHARES:
        if not len(left):
            break
        tree = tree or cKDTree(points)
        radii = np.clip(share * np.linalg.norm(left, axis=1), _LEAST_M, _LARGEST_M)
        own, is_plane, spreads = _fit(points, tree.query_ball_point(left, radii), radii)
        found.append(own[is_plane])
        left = left[~spreads]
    return np.concatenate(found)


def _seeds(points: Array) -> Array:
    """(s, 3) points, one of each cell, whose size grows with the range; of many, a selection."""
    size = np.clip(_SHARES[0] * np.linalg.norm(points, axis=1), 0.25, 1.0)
    steps = np.round(2 * np.log2(size))
    cells = name_cells(np.column_stack([steps, points / 2 ** (steps / 2)[:, None]]))
    first = np.unique(cells, return_index=True)[1]
    step = -(-len(first) // _MOST)
    return np.asarray(points[first[:: step or 1]])


def _fit(
    points: Array, near: NDArray[Any], radii: Array
) -> tuple[Planes, NDArray[np.bool_], NDArray[np.bool_]]:
    """The planes of neighbourhoods; (s,) which are planes, and which spread in two directions."""
    counts = np.fromiter(map(len, near), np.int64, len(near))
    of, rows = np.repeat(np.arange(len(near)), counts), np.concatenate([*near]).astype(np.int64)
    each = np.maximum(counts, 1)[:, None]

    def mean(values: Array) -> Array:
        sums = [np.bincount(of, column, len(near)) for column in values.T]
        return np.asarray(np.column_stack(sums) / each)

    centers = mean(points[rows])
    apart = points[rows] - centers[of]
    squares = mean((apart[:, :, None] * apart[:, None, :]).reshape(-1, 9)).reshape(-1, 3, 3)
    variances, vectors = np.linalg.eigh(squares)
    across, least, largest = variances.T
    spreads = (counts >= _POINTS) & (least > _ASPECT * largest) & (least > _SPREAD * radii**2)
    is_plane = spreads & (across < _FLAT * least) & (across < _ROUGH_M**2)
    normals = vectors[:, :, 0]
    normals = normals * np.where((normals * centers).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    tilts = np.sqrt(np.maximum(across, 0.0) / np.maximum(least, np.finfo(float).tiny))
    rays = centers / np.maximum(np.linalg.norm(centers, axis=1), np.finfo(float).tiny)[:, None]
    planes = np.empty(len(radii), PLANE)
    for name, values in zip(PLANE.names or (), (centers, normals, rays, radii, tilts), strict=True):
        planes[name] = values
    return planes, is_plane, spreads
