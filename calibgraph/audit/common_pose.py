"""One camera in several results: the pose that most share, and how far each is from the others.

Result r measures y_r, the pose of its camera in the camera of the common extrinsic, T_common_r =
exp(y_r), with covariance P_r. The weighted mean of the others is m_r, with covariance M_r:

    M_r^-1 = sum_s P_s^-1,   m_r = M_r sum_s P_s^-1 y_s,   s != r in the results that agree,
    d_r = y_r - m_r,         covariance P_r + M_r.

All to first order in the deviations of the results that agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import twists_between

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Poses:
    """One camera in the results that have an error bar of it.

    Attributes:
        results: (n,) their places in the order given.
        base: (4, 4) T_camera_lidar of one in the middle; all twists are relative to it.
        twist: (n, 6) y_r, rotation [rad], translation [m], in the camera's axes.
        covariance: (n, 6, 6) of y_r.
        information: (n, 6, 6) their inverses.
    """

    results: NDArray[np.intp]
    base: Array
    twist: Array
    covariance: Array
    information: Array

    def __len__(self) -> int:
        return len(self.results)

    def scatter(self, kept: Mask) -> float:
        """Squared sigmas by which these results are apart: of 6 (n - 1) degrees of freedom."""
        W, y = self.information[kept], self.twist[kept]
        mean = np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, y))
        return float(np.einsum("ni,nij,nj->", y - mean, W, y - mean))


def poses_of(results: list[int], T_camera_lidar: Array, covariance: Array) -> Poses:
    """The poses of one camera, relative to one in the middle.

    Args:
        results: (n,) places in the order given.
        T_camera_lidar: (n, 4, 4).
        covariance: (n, 6, 6) of xi in T_camera_lidar = exp(xi) estimate; positive definite.
    """
    from_first = twists_between(T_camera_lidar, T_camera_lidar[0])
    apart = np.linalg.norm(from_first - np.median(from_first, axis=0), axis=1)
    base = T_camera_lidar[int(np.argmin(apart))]
    twist = -twists_between(T_camera_lidar, base)
    information: Array = np.asarray(np.linalg.inv(covariance), np.float64)
    return Poses(np.array(results, np.intp), base, twist, covariance, information)


@dataclass(frozen=True)
class Limits:
    """From where on an axis deviates: both have to be exceeded.

    Attributes:
        sigmas: of the deviation.
        tolerance: (6,) rotation [rad], translation [m].
    """

    sigmas: float
    tolerance: Array

    def exceeded(self, deviation: Array, sigma: Array) -> Mask:
        """(..., 6) which axes of deviations are beyond both."""
        size = np.abs(deviation)
        beyond: Mask = (size > self.sigmas * sigma) & (size > self.tolerance)
        return beyond


@dataclass(frozen=True, eq=False)
class Deviations:
    """How far each result of one camera is from the others.

    Attributes:
        poses: of the camera.
        pool: (n,) the results whose mean each is compared with, itself excepted.
        agreeing: (n,) the largest part found that agrees.
        deviation: (n, 6) d_r.
        covariance: (n, 6, 6) of it.
        rivals: (n, n) whether result s may have changed in place of result r.
    """

    poses: Poses
    pool: Mask
    agreeing: Mask
    deviation: Array
    covariance: Array
    rivals: Mask

    @property
    def sigma(self) -> Array:
        """(n, 6) standard deviations."""
        return _sigmas(self.covariance)

    def coefficients(self, r: int) -> Array:
        """(n, 6, 6) by which the twist of each result enters d_r."""
        others = self.pool.copy()
        others[r] = False
        W = np.where(others[:, None, None], self.poses.information, 0.0)
        entering: Array = -np.linalg.inv(W.sum(axis=0)) @ W
        entering[r] = np.eye(6)
        return entering


def compare(poses: Poses, limits: Limits) -> Deviations:
    """Each result against the others that agree.

    The result that deviates most is removed from the mean of the others, until none that is left
    deviates. If no more than half are left, or the rest agrees as well with another result removed
    in place of this one, it is not known which of them changed: these are compared with each other.

    Args:
        poses: of one camera, at least two.
        limits: of a deviation.
    """
    agreeing = _agreeing(poses, limits)
    if 2 * np.count_nonzero(agreeing) > len(poses):
        rivals = _rivals(poses, agreeing, limits)
    else:
        rivals = ~np.eye(len(poses), dtype=np.bool_)
    pool = agreeing | rivals.any(axis=1)
    return Deviations(poses, pool, agreeing, *_from_others(poses, pool), rivals)


def _from_others(poses: Poses, kept: Mask) -> tuple[Array, Array]:
    """(n, 6) and (n, 6, 6) each result from the mean of the others among those that are kept."""
    own = np.where(kept[:, None, None], poses.information, 0.0)
    weighted = np.einsum("nij,nj->ni", own, poses.twist)
    of_mean = np.linalg.inv(own.sum(axis=0) - own)
    mean = np.einsum("nij,nj->ni", of_mean, weighted.sum(axis=0) - weighted)
    return poses.twist - mean, poses.covariance + of_mean


def _agreeing(poses: Poses, limits: Limits) -> Mask:
    """(n,) the results that are left, one at least."""
    kept = np.ones(len(poses), np.bool_)
    while np.count_nonzero(kept) > 1:
        deviation, covariance = _from_others(poses, kept)
        apart = kept & limits.exceeded(deviation, _sigmas(covariance)).any(axis=1)
        if not apart.any():
            break
        # By so much less would the rest scatter without each result.
        solved = np.linalg.solve(covariance, deviation[..., None])[..., 0]
        less = np.einsum("ni,ni->n", deviation, solved)
        kept[np.argmax(np.where(apart, less, -1.0))] = False
    return kept


def _rivals(poses: Poses, agreeing: Mask, limits: Limits) -> Mask:
    """(n, n) pairs of a removed result and one that is left, where the rest agrees either way."""
    rivals = np.zeros((len(poses), len(poses)), np.bool_)
    for removed in np.flatnonzero(~agreeing):
        for left in np.flatnonzero(agreeing):
            swapped = agreeing.copy()
            swapped[[removed, left]] = True, False
            deviation, covariance = _from_others(poses, swapped)
            apart = swapped & limits.exceeded(deviation, _sigmas(covariance)).any(axis=1)
            rivals[removed, left] = rivals[left, removed] = not apart.any()
    return rivals


def _sigmas(covariance: Array) -> Array:
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
