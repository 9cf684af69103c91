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

from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array, Mask


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Some places without their poses.

    Attributes:
        information: (6 n, 6 n) sum of M.
        vector: (6 n,) sum of M s.
        minimum: (P, n, 6) s.
        weight: (P, n, 6, 6) W.
        root: (P, 6 n, 6) X.
        cloud: (P, 6, 6) O^-1.
        at_place: (P, n, 6, 6) S.
        adjoint: (n, 6, 6) Ad.
    """

    information: Array
    vector: Array
    minimum: Array
    weight: Array
    root: Array
    cloud: Array
    at_place: Array
    adjoint: Array

    def displacements(self, shown: Array) -> tuple[Array, Array]:
        """(P, 6) u and (P, n, 6) v at (n, 6) r."""
        apart = self.minimum - shown
        flat = apart.reshape(*self.root.shape[:2], 1)
        u = -(self.cloud @ (self.root.swapaxes(1, 2) @ flat))[..., 0]
        left = apart + (self.adjoint @ u[:, None, :, None])[..., 0]
        return u, (self.at_place @ (self.weight @ left[..., None]))[..., 0]

    def covariances(self, shown: Array) -> tuple[Array, Array]:
        """(P, 6, 6) of u and (P, n, 6, 6) of v, with the (6 n, 6 n) covariance of r."""
        gain = self.cloud @ self.root.swapaxes(1, 2)
        of_u = self.cloud + gain @ shown @ gain.swapaxes(1, 2)
        places, cameras = self.minimum.shape[:2]
        moved = (self.adjoint @ gain[:, None]).reshape(places, cameras, 6, cameras, 6)
        each = np.arange(cameras)
        moved[:, each, :, each] -= np.eye(6)
        moved = moved.reshape(places, cameras, 6, -1)
        by_cloud = self.adjoint @ self.cloud[:, None] @ self.adjoint.swapaxes(1, 2)
        apart = moved @ shown @ moved.swapaxes(2, 3) + by_cloud
        known = self.weight - self.weight @ apart @ self.weight
        return of_u, self.at_place - self.at_place @ known @ self.at_place


def eliminate(
    information: Array,
    minimum: Array,
    at_place: Array,
    cloud_at_place: Array,
    *,
    adjoint: Array,
    seen: Mask,
) -> Eliminated:
    """Eliminate the poses of places.

    Args:
        information: (P, n, 6, 6) A, positive definite.
        minimum: (P, n, 6) s.
        at_place: (P, n, 6, 6) S.
        cloud_at_place: (P, 6, 6) C.
        adjoint: (n, 6, 6) Ad.
        seen: (P, n) which cameras have matches at which places.
    """
    places, cameras = seen.shape
    found = np.linalg.inv(np.linalg.inv(information) + at_place)
    weight: Array = (found + found.swapaxes(2, 3)) * (0.5 * seen[..., None, None])
    root = np.asarray(weight @ adjoint)
    full = np.linalg.inv(cloud_at_place) + (adjoint.swapaxes(1, 2) @ root).sum(axis=1)
    cloud = np.asarray(np.linalg.inv(full))
    root = root.reshape(places, 6 * cameras, 6)
    by_cloud = root @ cloud
    whole = block_diagonal(weight.sum(axis=0))
    whole -= np.tensordot(by_cloud, root, axes=((0, 2), (0, 2)))
    pull = (weight @ minimum[..., None]).reshape(places, 6 * cameras, 1)
    flat = minimum.reshape(places, 6 * cameras, 1)
    vector = (pull - by_cloud @ (root.swapaxes(1, 2) @ flat)).sum(axis=0)[:, 0]
    return Eliminated(
        (whole + whole.T) / 2, vector, minimum, weight, root, cloud, at_place, adjoint
    )


def block_diagonal(blocks: Array) -> Array:
    """(6 n, 6 n) from (n, 6, 6)."""
    n = len(blocks)
    matrix = np.zeros((n, 6, n, 6))
    matrix[np.arange(n), :, np.arange(n)] = blocks
    return matrix.reshape(6 * n, 6 * n)
