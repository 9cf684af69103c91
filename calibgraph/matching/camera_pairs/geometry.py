"""Robust geometry on rays: epipolar, the relative pose; and the surfaces of the LiDAR at them.

On a plane g . X = 1, a point X = r f at range r along the unit ray f has 1 / r = g . f: the inverse
range is linear in the ray, for any lens. So g comes from a linear fit to the LiDAR points that
project next to the feature.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import gammaln

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera
from calibgraph.solver.pnp import magsac, ransac_on_plane
from factors import ray_spreads

MAX_LOG10_FALSE_ALARMS = -3.0
"""One pair of cameras in a thousand that see nothing in common may be taken for overlapping."""

_THRESHOLD_PX = 1.0  # of MAGSAC, a scale that it need not know exactly
_ITERATIONS = 5000
_SAMPLE, _MODELS = 5, 10  # matches that determine an essential matrix, and at most how many of them
MAX_ANGLE_RAD = math.radians(60.0)  # off the mean ray: a plane magnifies the errors of wider rays
_FOCAL_PX = 1000.0

MIN_INLIERS = 12
"""Features that must agree on a pose: 4 determine one, and of those that agree on an epipolar
geometry few others agree by chance."""

_THRESHOLD_RAD = math.radians(0.3)  # depths beside silhouettes, of an estimate a degree off
_PNP_ITERATIONS = 2000


def agree_on_epipolar_geometry(
    a: Camera, b: Camera, rays_a: Array, rays_b: Array, *, seed: int
) -> NDArray[np.bool_]:
    """Find the matches of two cameras that agree on an essential matrix.

    OpenCV estimates it on planes across the mean rays, and all matches are tested on their rays.
    The cameras' extrinsics are not used. Up to which residual matches are taken follows from the
    number of false alarms, which is least there (Moisan and Stival, 2004).

    Args:
        a: lens and image size of the one camera.
        b: of the other.
        rays_a: (n, 3) unit rays of the matches in the one.
        rays_b: (n, 3) of the same in the other.
        seed: of the choice of samples.

    Returns:
        (n,) the matches that agree; none where as many agree by chance.
    """
    none = np.zeros(len(rays_a), np.bool_)
    essential = _essential_matrix(rays_a, rays_b, (a, b), seed)
    if essential is None:
        return none
    residuals = np.abs(sampson_px(essential, (a, b), (rays_a, rays_b)))
    false_alarms, limit_px = log10_false_alarms(residuals, (a, b))
    if false_alarms > MAX_LOG10_FALSE_ALARMS:
        return none
    return np.asarray(residuals <= limit_px)


def sampson_px(
    essential: Array, cameras: tuple[Camera, Camera], rays: tuple[Array, Array]
) -> Array:
    """(n,) Sampson's residuals on rays [px] of ``ray_b . E ray_a = 0``."""
    spread_a, spread_b = (ray_spreads(c.lens, r) for c, r in zip(cameras, rays, strict=True))
    normal_b, normal_a = rays[0] @ essential.T, rays[1] @ essential
    value = np.einsum("ni,ni->n", rays[1], normal_b)
    sides = [
        np.einsum("nij,ni->nj", spread, normal)
        for spread, normal in ((spread_a, normal_a), (spread_b, normal_b))
    ]
    square = sum((side**2).sum(axis=1) for side in sides)
    return np.asarray(value / np.sqrt(np.maximum(square, np.finfo(float).tiny)))


def log10_false_alarms(residuals_px: Array, cameras: tuple[Camera, Camera]) -> tuple[float, float]:
    """Expected number (log10) of agreements as good as the best, if all matches were random.

    A random match is within r px of its epipolar lines with a probability of at most
    2 sqrt(2) r D / A, of an image with diagonal D and area A.

    Args:
        residuals_px: (n,) absolute Sampson residuals.
        cameras: their image sizes.

    Returns:
        The least number over all limits of the residual, and that limit [px].
    """
    n = len(residuals_px)
    if n <= _SAMPLE:
        return 0.0, 0.0
    ordered = np.sort(residuals_px)[_SAMPLE:]
    k = np.arange(_SAMPLE + 1, n + 1, dtype=np.float64)
    band = max(2 * math.sqrt(2) * math.hypot(c.width_px, c.height_px) / (c.width_px * c.height_px)
               for c in cameras)  # fmt: skip
    chance = np.clip(band * ordered, 1e-12, 1.0)
    choices = _log_binomial(np.full_like(k, n), k) + _log_binomial(k, np.full_like(k, _SAMPLE))
    alarms = math.log(_MODELS * (n - _SAMPLE)) + choices + (k - _SAMPLE) * np.log(chance)
    best = int(np.argmin(alarms))
    return float(alarms[best]) / math.log(10), float(ordered[best])


def _log_binomial(n: Array, k: Array) -> Array:
    return np.asarray(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))


def _essential_matrix(
    rays_a: Array, rays_b: Array, cameras: tuple[Camera, Camera], seed: int
) -> Array | None:
    """(3, 3) E of ``ray_b . E ray_a = 0``; None if there is none."""
    if len(rays_a) <= _SAMPLE:
        return None
    turns = [turn_to_axis(rays) for rays in (rays_a, rays_b)]
    turned = [rays @ turn.T for rays, turn in zip((rays_a, rays_b), turns, strict=True)]
    narrow = np.all([rays[:, 2] > math.cos(MAX_ANGLE_RAD) for rays in turned], axis=0)
    if np.count_nonzero(narrow) <= _SAMPLE:
        return None
    a, b = (_FOCAL_PX * rays[narrow, :2] / rays[narrow, 2:] for rays in turned)
    ideal = np.diag([_FOCAL_PX, _FOCAL_PX, 1.0])
    focal = min(camera.lens.pixels_per_rad for camera in cameras)
    parameters = magsac(_THRESHOLD_PX * _FOCAL_PX / focal, iterations=_ITERATIONS, seed=seed)
    try:
        found, _ = cv2.findEssentialMat(a, b, ideal, ideal, None, None, parameters)
    except cv2.error:  # degenerate samples
        return None
    if found is None or found.shape != (3, 3):
        return None
    return np.asarray(turns[1].T @ found @ turns[0])


def relative_pose(points_a_m: Array, rays_b: Array, *, seed: int) -> Array | None:
    """T_b_a from points in the frame of camera A and the rays on which camera B sees them.

    MAGSAC and PnP on the plane across the mean ray, so that any field of view serves.

    Args:
        points_a_m: (n, 3).
        rays_b: (n, 3) unit vectors.
        seed: of the choice of samples.

    Returns:
        (4, 4); None if too few agree on a pose.
    """
    if len(rays_b) < MIN_INLIERS:
        return None
    turn = turn_to_axis(rays_b)
    turned = rays_b @ turn.T
    narrow = turned[:, 2] > math.cos(MAX_ANGLE_RAD)
    if np.count_nonzero(narrow) < MIN_INLIERS:
        return None
    plane = turned[narrow, :2] / turned[narrow, 2:]
    parameters = magsac(_THRESHOLD_RAD * _FOCAL_PX, iterations=_PNP_ITERATIONS, seed=seed)
    found = ransac_on_plane(points_a_m[narrow], plane, _FOCAL_PX, parameters, turn=turn)
    return None if found is None or found[1] < MIN_INLIERS else found[0]


def turn_to_axis(rays: Array) -> Array:
    """(3, 3) the shortest rotation that takes the mean ray to the z axis."""
    return np.asarray(Rotation.align_vectors([0.0, 0.0, 1.0], rays.mean(axis=0))[0].as_matrix())


NEIGHBOURS = 24
NEIGHBOUR_RAD = np.radians(2.5)  # of a neighbour: beyond, the LiDAR's rows are too far apart
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


def points_at(rays: Array, points_camera_m: Array) -> tuple[NDArray[np.bool_], Array]:
    """Which of the rays (n, 3) meet a plane of the cloud, and (k, 3) where; see `planes_at`."""
    inverse = np.einsum("ni,ni->n", planes_at(rays, points_camera_m), rays)
    near = inverse > 0  # false where there is no plane
    return near, rays[near] / inverse[near, None]


def _near_rays(directions: Array, rays: Array) -> NDArray[np.bool_]:
    """(m,) the directions inside the cone about the rays, with a margin."""
    axis = rays.mean(axis=0)
    axis /= max(float(np.linalg.norm(axis)), np.finfo(float).tiny)
    widest = np.arccos(np.clip((rays @ axis).min(), -1.0, 1.0)) + NEIGHBOUR_RAD
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
    usable = (np.linalg.eigvalsh(normal)[:, 0] > _MIN_SPREAD) & (width[:, 0] < NEIGHBOUR_RAD)
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
