"""The LiDAR's surfaces at features of an image: local planes of inverse range.

On a plane g . X = 1, a point X = r f at range r along the unit ray f has 1 / r = g . f: the inverse
range is linear in the ray, for any lens. So g comes from a linear fit to the LiDAR points that
project next to the feature.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array

NEIGHBOURS = 24
MAX_ANGLE_RAD = np.radians(2.5)  # of a neighbour: beyond, the LiDAR's rows are too far apart
MAX_RELATIVE_SCATTER = 0.02  # of the neighbours' inverse ranges about their plane
MIN_RANGE_M = 1.0  # nearer points are of the vehicle itself

_MIN_SPREAD = 0.02  # least eigenvalue of the neighbours' second moments; 0: all on one line


def planes_at(rays: Array, points_camera_m: Array) -> Array:
    """Planes of the LiDAR points next to rays.

    None where neighbours are far, lie to one side or on a line, or do not lie on a plane, as at
    silhouettes, where some are on the object in front and some behind it.

    Args:
        rays: (n, 3) unit vectors in the camera frame.
        points_camera_m: (m, 3) the cloud in the camera frame.

    Returns:
        (n, 3) g [1/m] with g . X = 1 for points X of the plane in the camera frame; NaN where
        there is none.
    """
    distance = np.linalg.norm(points_camera_m, axis=1)
    far = distance > MIN_RANGE_M
    directions, inverse = points_camera_m[far] / distance[far, None], 1.0 / distance[far]
    near = _near_rays(directions, rays) if len(rays) else np.zeros(len(directions), np.bool_)
    directions, inverse = directions[near], inverse[near]
    if len(directions) < NEIGHBOURS:
        return np.full((len(rays), 3), np.nan)
    chords, rows = cKDTree(directions, balanced_tree=False).query(rays, NEIGHBOURS)
    return _fit_planes(rays, directions[rows], inverse[rows], chords)


def _near_rays(directions: Array, rays: Array) -> NDArray[np.bool_]:
    """(m,) the directions inside the cone about the rays, with a margin."""
    axis = rays.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), np.finfo(float).tiny)
    widest = np.arccos(np.clip((rays @ axis).min(), -1.0, 1.0)) + MAX_ANGLE_RAD
    return np.asarray(directions @ axis > np.cos(min(widest, np.pi)))


def _fit_planes(rays: Array, directions: Array, inverse: Array, chords: Array) -> Array:
    """Fit (n, 3) planes at rays to (n, k, 3) directions and (n, k) inverse ranges next to them."""
    width = chords[:, -1:]
    across = _tangent_bases(rays) / width[:, :, None]
    axes = np.concatenate([rays[:, None], across], axis=1)  # g = axes^T coefficients
    design = directions @ axes.transpose(0, 2, 1)
    weights = np.exp(-2.0 * (chords / width) ** 2)
    weights /= weights.sum(axis=1, keepdims=True)
    weighted = design * weights[:, :, None]
    normal = weighted.transpose(0, 2, 1) @ design
    usable = (np.linalg.eigvalsh(normal)[:, 0] > _MIN_SPREAD) & (width[:, 0] < MAX_ANGLE_RAD)
    normal[~usable] = np.eye(3)
    moments = np.einsum("nki,nk->ni", weighted, inverse)
    coefficients = np.linalg.solve(normal, moments[:, :, None])
    errors = inverse - (design @ coefficients)[:, :, 0]
    scatter = np.sqrt((weights * errors**2).sum(axis=1))
    usable &= scatter < MAX_RELATIVE_SCATTER * coefficients[:, 0, 0]
    planes = (axes.transpose(0, 2, 1) @ coefficients)[:, :, 0]
    return np.asarray(np.where(usable[:, None], planes, np.nan))


def _tangent_bases(rays: Array) -> Array:
    """(n, 2, 3) two unit vectors orthogonal to each ray and to each other."""
    along_z = np.abs(rays[:, 2:]) > np.sqrt(0.5)
    first = np.cross(rays, np.where(along_z, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=1)
