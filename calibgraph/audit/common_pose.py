"""One camera in several results: the pose that most share, and how far each is from the others.

Result r measures y_r, the pose of its camera in the camera of the common extrinsic, T_common_r =
exp(y_r), with covariance P_r. The weighted mean of the others is m_r, with covariance M_r:

    M_r^-1 = sum_s P_s^-1,   m_r = M_r sum_s P_s^-1 y_s,   s != r in the results that agree,
    d_r = y_r - m_r,         covariance P_r + M_r.

All to first order in the deviations of the results that agree. A covariance that was estimated
from F frames is itself uncertain, so that deviations follow Student's law, with as many degrees of
freedom as Welch and Satterthwaite's formula gives for the sum of P_r and M_r on an axis.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from calibgraph.arrays import Array, Mask
from calibgraph.audit.significance import axes_beyond
from calibgraph.model.geometry import twists_between


@dataclass(frozen=True, eq=False)
class Poses:
    """One camera in the results that have an error bar of it.

    Attributes:
        results: (n,) their places in the order given.
        base: (4, 4) T_camera_lidar of one in the middle; all twists are relative to it.
        twist: (n, 6) y_r, rotation [rad], translation [m], in the camera's axes.
        covariance: (n, 6, 6) of y_r.
        information: (n, 6, 6) their inverses.
        freedom: (n,) degrees of freedom of the covariances.
    """

    results: NDArray[np.intp]
    base: Array
    twist: Array
    covariance: Array
    information: Array
    freedom: Array

    def __len__(self) -> int:
        return len(self.results)

    def scatter(self, kept: Mask) -> float:
        """Chi-squared of these results about their mean, with 6 (n - 1) degrees of freedom."""
        W, y = self.information[kept], self.twist[kept]
        mean = np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, y))
        return float(np.einsum("ni,nij,nj->", y - mean, W, y - mean))


def poses_of(results: list[int], T_camera_lidar: Array, covariance: Array, freedom: Array) -> Poses:
    """The poses of one camera, relative to one in the middle.

    Args:
        results: (n,) places in the order given.
        T_camera_lidar: (n, 4, 4).
        covariance: (n, 6, 6) of xi in T_camera_lidar = exp(xi) estimate; positive definite.
        freedom: (n,) degrees of freedom of the covariances.
    """
    distances = [np.linalg.norm(twists_between(T_camera_lidar, T), axis=1) for T in T_camera_lidar]
    base = T_camera_lidar[int(np.argmin(np.sum(distances, axis=1)))]
    twist = -twists_between(T_camera_lidar, base)
    information: Array = np.asarray(np.linalg.inv(covariance), np.float64)
    return Poses(np.array(results, np.intp), base, twist, covariance, information, freedom)


@dataclass(frozen=True)
class Limits:
    """An axis deviates if it is significant, and such axes together exceed the tolerance.

    Attributes:
        tail: probability of a larger deviation by chance, to either side.
        tolerance: (2,) of a turn [rad], of a shift [m].
    """

    tail: float
    tolerance: Array

    def sigmas(self, freedom: Array) -> Array:
        """Number of sigmas that is significant with these degrees of freedom."""
        return np.asarray(-stdtrit(freedom, self.tail), np.float64)

    def exceeded(self, deviation: Array, sigma: Array, freedom: Array) -> Mask:
        """(..., 6) True for axes beyond both limits."""
        significant = np.abs(deviation) > self.sigmas(freedom) * sigma
        return axes_beyond(deviation, significant, self.tolerance)


@dataclass(frozen=True, eq=False)
class LeaveOneOutDeviation:
    """Deviation of each result from the weighted mean of the others.

    Attributes:
        deviation: (n, 6) d_r.
        covariance: (n, 6, 6) of it.
        freedom: (n, 6) degrees of freedom of its variances.
    """

    deviation: Array
    covariance: Array
    freedom: Array

    @property
    def sigma(self) -> Array:
        """(n, 6) standard deviations."""
        return np.sqrt(_variances(self.covariance))

    def axes_beyond(self, limits: Limits) -> Mask:
        """(n, 6) which axes are beyond the limits."""
        return limits.exceeded(self.deviation, self.sigma, self.freedom)

    def beyond(self, limits: Limits) -> Mask:
        """(n,) True for results with an axis beyond the limits."""
        return np.asarray(self.axes_beyond(limits).any(axis=1))


@dataclass(frozen=True, eq=False)
class Deviations:
    """How far each result of one camera is from the others.

    Attributes:
        pool: (n,) the results whose mean each is compared with, itself excepted.
        agreeing: (n,) the largest part found that agrees.
        leave_one_out: deviation of each from that mean.
        ambiguous: (n, n) True where result s may have changed in place of result r.
    """

    poses: Poses
    pool: Mask
    agreeing: Mask
    leave_one_out: LeaveOneOutDeviation
    ambiguous: Mask

    def coefficients(self, r: int) -> Array:
        """(n, 6, 6) derivative of d_r by the twist of each result."""
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
    """
    agreeing = _agreeing(poses, limits)
    if 2 * np.count_nonzero(agreeing) > len(poses):
        ambiguous = _ambiguous_pairs(poses, agreeing, limits)
    else:
        ambiguous = ~np.eye(len(poses), dtype=np.bool_)
    pool = agreeing | ambiguous.any(axis=1)
    return Deviations(poses, pool, agreeing, _leave_one_out(poses, pool), ambiguous)


def _leave_one_out(poses: Poses, kept: Mask) -> LeaveOneOutDeviation:
    """Deviation of each result from the mean of the other kept results."""
    W = np.where(kept[:, None, None], poses.information, 0.0)
    of_mean = np.linalg.inv(_sums_of_others(W))
    weighted = _sums_of_others(np.einsum("nij,nj->ni", W, poses.twist))
    mean = np.einsum("nij,nj->ni", of_mean, weighted)
    covariance = poses.covariance + of_mean
    own = _variances(poses.covariance) / _variances(covariance)
    of_others = _sums_of_others(poses.freedom * kept)[:, None]
    freedom = 1 / (own**2 / poses.freedom[:, None] + (1 - own) ** 2 / of_others)
    return LeaveOneOutDeviation(poses.twist - mean, covariance, freedom)


def _sums_of_others(values: Array) -> Array:
    """Per entry of the first axis, the sum of all others; exact where one is far the largest."""
    before, after = np.zeros_like(values), np.zeros_like(values)
    before[1:] = np.cumsum(values[:-1], axis=0)
    after[:-1] = np.cumsum(values[:0:-1], axis=0)[::-1]
    return before + after


def _agreeing(poses: Poses, limits: Limits) -> Mask:
    """(n,) the results that are left, one at least."""
    kept = np.ones(len(poses), np.bool_)
    while np.count_nonzero(kept) > 1:
        found = _leave_one_out(poses, kept)
        beyond = kept & found.beyond(limits)
        if not beyond.any():
            break
        # Decrease of the chi-squared of the rest when each result is removed.
        solved = np.linalg.solve(found.covariance, found.deviation[..., None])[..., 0]
        less = np.einsum("ni,ni->n", found.deviation, solved)
        kept[np.argmax(np.where(beyond, less, -1.0))] = False
    return kept


def _ambiguous_pairs(poses: Poses, agreeing: Mask, limits: Limits) -> Mask:
    """(n, n) pairs of a removed result and one that is left, where the rest agrees either way."""
    ambiguous = np.zeros((len(poses), len(poses)), np.bool_)
    for removed in np.flatnonzero(~agreeing):
        for left in np.flatnonzero(agreeing):
            swapped = agreeing.copy()
            swapped[[removed, left]] = True, False
            agrees = not (swapped & _leave_one_out(poses, swapped).beyond(limits)).any()
            ambiguous[removed, left] = ambiguous[left, removed] = agrees
    return ambiguous


def _variances(covariance: Array) -> Array:
    """(n, 6) diagonals of (n, 6, 6) covariances."""
    return np.asarray(np.diagonal(covariance, axis1=1, axis2=2))
