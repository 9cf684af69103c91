"""The LiDAR's range at features of an image: local planes of inverse range.

On a plane n . X = d, a point X = r f at range r along the unit ray f has 1 / r = n . f / d: the
inverse range is linear in the ray, for any lens. So the inverse range of a feature is that of the
plane through the LiDAR points that project next to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

NEIGHBOURS = 24
MAX_ANGLE_RAD = np.radians(2.5)  # of a neighbour: beyond, the LiDAR's rows are too far apart
MAX_RELATIVE_SCATTER = 0.02  # of the neighbours' inverse ranges about their plane
MIN_RANGE_M = 1.0  # nearer points are of the vehicle itself


@dataclass(frozen=True, eq=False)
class PlaneFits:
    """Planes of inverse range, one per ray.

    Attributes:
        ranges_m: (n,) NaN where there is none.
        sigmas_m: (n,) their standard deviations, by the scatter about the planes.
    """

    ranges_m: Array
    sigmas_m: Array


def ranges_along(rays: Array, points_camera_m: Array) -> PlaneFits:
    """Ranges along rays by local planes of inverse range through the points next to them.

    None where neighbours are far, lie to one side or on a line, or do not lie on a plane, as at
    silhouettes, where some are on the object in front and some on what is behind.

    Args:
        rays: (n, 3) unit vectors in the camera frame.
        points_camera_m: (m, 3) the cloud in the camera frame.
    """
    distance = np.linalg.norm(points_camera_m, axis=1)
    far = distance > MIN_RANGE_M
    points, distance = points_camera_m[far], distance[far]
    none = np.full(len(rays), np.nan)
    if len(points) < NEIGHBOURS or not len(rays):
        return PlaneFits(none, none)
    directions = points / distance[:, None]
    near = _in_front(directions, rays)
    directions, inverse = directions[near], 1.0 / distance[near]
    if len(directions) < NEIGHBOURS:
        return PlaneFits(none, none)
    chords, rows = cKDTree(directions).query(rays, NEIGHBOURS)
    return _fit_planes(rays, directions[rows], inverse[rows], chords)


def _in_front(directions: Array, rays: Array) -> NDArray[np.bool_]:
    """(m,) the directions inside the cone about the rays, with a margin."""
    axis = rays.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), np.finfo(float).tiny)
    widest = np.arccos(np.clip((rays @ axis).min(), -1.0, 1.0)) + MAX_ANGLE_RAD
    return np.asarray(directions @ axis > np.cos(min(widest, np.pi)))


def _fit_planes(rays: Array, directions: Array, inverse: Array, chords: Array) -> PlaneFits:
    """Fit the planes of (n, k, 3) directions and (n, k) inverse ranges at (n, 3) rays."""
    width = chords[:, -1:]
    across = _tangent_bases(rays)
    offsets = np.einsum("nkj,nij->nki", directions, across) / width[:, :, None]
    weights = np.exp(-2.0 * (chords / width) ** 2)
    design = np.concatenate([np.ones((*inverse.shape, 1)), offsets], axis=2)
    weighted = design * weights[:, :, None]
    normal = weighted.transpose(0, 2, 1) @ design
    scaled = normal / weights.sum(axis=1)[:, None, None]
    spread_out = np.linalg.eigvalsh(scaled)[:, 0] > _MIN_SPREAD
    usable = spread_out & (width[:, 0] < MAX_ANGLE_RAD)
    normal[~usable] = np.eye(3)
    covariance = np.linalg.inv(normal)
    plane = np.einsum("nij,nkj,nk->ni", covariance, weighted, inverse)
    errors = inverse - np.einsum("nki,ni->nk", design, plane)
    at_ray = plane[:, 0]
    scatter = np.sqrt((weights * errors**2).sum(axis=1) / weights.sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        usable &= (at_ray > 0) & (scatter < MAX_RELATIVE_SCATTER * at_ray)
        ranges = np.where(usable, 1.0 / at_ray, np.nan)
    least = _LIDAR_SIGMA_M / ranges**2
    sigma = np.hypot(scatter, least) * np.sqrt(covariance[:, 0, 0])
    return PlaneFits(ranges, sigma * ranges**2)


_MIN_SPREAD = 0.02  # least eigenvalue of the neighbours' second moments; 0: all on one line
_LIDAR_SIGMA_M = 0.02  # of a LiDAR's range, where the scatter of a few points is smaller by chance


def _tangent_bases(rays: Array) -> Array:
    """(n, 2, 3) two unit vectors orthogonal to each ray and to each other."""
    helper = np.where(np.abs(rays[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])  # noqa: PLR2004
    first = np.cross(rays, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=1)
