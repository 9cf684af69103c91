"""The poses of places, eliminated in closed form: what is left is a quadratic on the cameras.

Matches of camera c at place p are a quadratic of information A about the pose at s, a tangent step
from the camera's reference; matches show that camera at all places at r. The cloud is displaced by
u at the place, in the LiDAR's axes, and the camera's matches by v, both about zero:

    cost = sum_c (s - r + Ad u - v)^T A (s - r + Ad u - v) + v^T S^-1 v  +  u^T C^-1 u

    v  eliminated:  W = (A^-1 + S)^-1  on  s - r + Ad u
    u  eliminated:  M = diag(W) - X O^-1 X^T,   X = [W Ad],   O = C^-1 + sum_c Ad^T W Ad
    left:           (s - r)^T M (s - r),   summed over places

All places at once: (P, n, 6, 6) arrays and no loop. Ad is that of T_camera_lidar.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from calibgraph.arrays import Array


class Eliminated(NamedTuple):
    """Some places without their poses.

    Attributes:
        information: (6 n, 6 n) sum of M.
        vector: (6 n,) sum of M s.
        minimum: (P, n, 6) s.
        weight: (P, n, 6, 6) W.
        root: (P, 6 n, 6) X.
        cloud: (P, 6, 6) O^-1.
        adjoint: (n, 6, 6) Ad.
    """

    information: Array
    vector: Array
    minimum: Array
    weight: Array
    root: Array
    cloud: Array
    adjoint: Array

    def displacements(self, shown: Array, at_place: Array) -> tuple[Array, Array]:
        """(P, 6) u and (P, n, 6) v at (n, 6) r, for (P, n, 6, 6) S."""
        apart = self.minimum - shown
        flat = apart.reshape(*self.root.shape[:2], 1)
        u = -(self.cloud @ (self.root.swapaxes(1, 2) @ flat))[..., 0]
        left = apart + (self.adjoint @ u[:, None, :, None])[..., 0]
        return u, (at_place @ (self.weight @ left[..., None]))[..., 0]

    def covariances(self, shown: Array, at_place: Array) -> tuple[Array, Array]:
        """(P, 6, 6) of u and (P, n, 6, 6) of v, with the (6 n, 6 n) covariance of r."""
        gain = self.cloud @ self.root.swapaxes(1, 2)
        of_u = self.cloud + gain @ shown @ gain.swapaxes(1, 2)
        places, cameras = self.minimum.shape[:2]
        moved = (self.adjoint @ gain[:, None]).reshape(places, cameras, 6, cameras, 6)
        each = np.arange(cameras)
        moved[:, each, :, each] -= np.eye(6)
        moved = moved.reshape(places, cameras, 6, 6 * cameras)
        by_cloud = self.adjoint @ self.cloud[:, None] @ self.adjoint.swapaxes(1, 2)
        apart = moved @ shown @ moved.swapaxes(2, 3) + by_cloud
        known = self.weight - self.weight @ apart @ self.weight
        return of_u, at_place - at_place @ known @ at_place


def eliminate(
    weight: Array, minimum: Array, cloud_information: Array, adjoint: Array
) -> Eliminated:
    """Eliminate the poses of places.

    Args:
        weight: (P, n, 6, 6) W, symmetric; zero where a camera has no matches.
        minimum: (P, n, 6) s.
        cloud_information: (P, 6, 6) C^-1.
        adjoint: (n, 6, 6) Ad.
    """
    places, cameras = weight.shape[:2]
    root = weight @ adjoint
    cloud = np.linalg.inv(cloud_information + (adjoint.swapaxes(1, 2) @ root).sum(axis=1))
    pull = (weight @ minimum[..., None]).reshape(places, 6 * cameras, 1)
    root = root.reshape(places, 6 * cameras, 6)
    by_cloud = root @ cloud
    flat = minimum.reshape(places, 6 * cameras, 1)
    vector = (pull - by_cloud @ (root.swapaxes(1, 2) @ flat)).sum(axis=0)[:, 0]
    shared = (by_cloud @ root.swapaxes(1, 2)).sum(axis=0)
    information = block_diagonal(weight.sum(axis=0)) - (shared + shared.T) / 2
    return Eliminated(information, vector, minimum, weight, root, np.asarray(cloud), adjoint)


def block_diagonal(blocks: Array) -> Array:
    """(6 n, 6 n) from (n, 6, 6)."""
    n = len(blocks)
    matrix = np.zeros((n, 6, n, 6))
    matrix[np.arange(n), :, np.arange(n)] = blocks
    return matrix.reshape(6 * n, 6 * n)
