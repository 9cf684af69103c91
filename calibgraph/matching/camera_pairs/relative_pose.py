"""The relative pose of two cameras from features whose depth the LiDAR gives: robust PnP."""

import math

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.camera_pairs.geometry import MAX_ANGLE_RAD, turn_to_axis
from calibgraph.solver.pnp import magsac, ransac_on_plane

MIN_INLIERS = 12
"""Features that must agree on a pose: 4 determine one, and of those that agree on an epipolar
geometry few others agree by chance."""

_THRESHOLD_RAD = math.radians(
    0.3
)  # depths beside silhouettes, of an estimate a degree off, are off
_ITERATIONS = 2000
_FOCAL_PX = 1000.0


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
    parameters = magsac(_THRESHOLD_RAD * _FOCAL_PX, iterations=_ITERATIONS, seed=seed)
    found = ransac_on_plane(points_a_m[narrow], plane, _FOCAL_PX, parameters, turn=turn)
    return None if found is None or found[1] < MIN_INLIERS else found[0]
