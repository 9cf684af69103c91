"""The model of `drift` and of fleets: which of several measured poses of one camera deviates?

Measurement r is y_r = c + d_r + e_r, a twist from a pose nearby: the centre c that all share, the
deviation d_r of the vehicle, and the error e_r ~ N(0, P_r). A deviation is regular, d ~ N(0, S), or
the camera was moved, d ~ N(0, M) with a much larger M. What r tells of the centre is

    W_r = p_r (S + P_r)^-1 + (1 - p_r) (M + P_r)^-1,   p_r the probability that it is regular.

* One vehicle (`drift`): its camera has one pose, S = 0, and may have moved anywhere, M^-1 = 0. Few
  results cannot teach a share, so a test that bounds the false alarms of a call sets p_r: 0 or 1.
* Many vehicles (`fleet`): S, M and the share of moved cameras are learnt, p_r is the posterior.

A covariance from F frames is itself uncertain: in the tests deviations follow Student's law, with
Welch and Satterthwaite's degrees of freedom of the sum of P_r and the centre's covariance.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, Mask
from calibgraph.audit.judgement import Limits
from calibgraph.model.geometry import twists_between

_EYE = np.eye(6)


def weighted_mean(y: Array, information: Array) -> tuple[Array, Array]:
    """(6,) the centre of (n, 6) twists with (n, 6, 6) information, and its (6, 6) covariance."""
    covariance = np.linalg.inv(information.sum(axis=0))
    return covariance @ np.einsum("nij,nj->i", information, y), (covariance + covariance.T) / 2


@dataclass(frozen=True, eq=False)
class Posterior:
    """Deviations given their measurements; arrays of two have the regular case first.

    Attributes:
        share: (2, n) probability of each case.
        gain: (2, n, 6, 6) what of a measured deviation is believed.
        spread: (2, 6, 6) covariance of the deviations of each case.
        information: (n, 6, 6) W_r, about the centre.
    """

    share: Array
    gain: Array
    spread: Array
    information: Array

    def deviations(self, y: Array, center: Array) -> tuple[Array, Array]:
        """The deviations from a centre that is itself uncertain, both cases mixed.

        Args:
            y: (n, 6) measured, from the estimate of the centre.
            center: (n, 6, 6) covariance of that estimate, which rests on these measurements too.

        Returns:
            (n, 6) means; (n, 6, 6) covariances of what is measured (centre plus deviation).
        """
        means = np.einsum("knij,nj->kni", self.gain, y)
        rest = _EYE - self.gain
        each = rest @ self.spread[:, None] + rest @ center @ rest.swapaxes(-1, -2)
        mean = np.einsum("kn,kni->ni", self.share, means)
        apart = means - mean
        each += apart[..., :, None] * apart[..., None, :]
        covariance = np.einsum("kn,knij->nij", self.share, each)
        return mean, (covariance + covariance.swapaxes(-1, -2)) / 2

    def second_moments(self, y: Array, center: Array) -> Array:
        """(2, n, 6, 6) expectation of d d^T in each case, over the centre's uncertainty too.

        With a flat prior of the topmost centre this makes EM the restricted maximum likelihood:
        what the centre takes out of the scatter is put back.
        """
        means = np.einsum("knij,nj->kni", self.gain, y)
        moments = (_EYE - self.gain) @ self.spread[:, None]
        moments += self.gain @ center @ self.gain.swapaxes(-1, -2)
        moments += means[..., :, None] * means[..., None, :]
        return np.asarray((moments + moments.swapaxes(-1, -2)) / 2)


def weigh(y: Array, noise: Array, spread: Array, share_moved: float) -> Posterior:
    """Which case each deviation is of, and what follows.

    Args:
        y: (n, 6) measured deviations.
        noise: (n, 6, 6) covariances of their measurements.
        spread: (2, 6, 6) of regular and of moved deviations.
        share_moved: of all, before anything is measured.
    """
    total = spread[:, None] + noise
    inverse = np.linalg.inv(total)
    inverse = (inverse + inverse.swapaxes(-1, -2)) / 2
    squared = np.einsum("ni,knij,nj->kn", y, inverse, y)
    log = -0.5 * (squared + np.linalg.slogdet(total)[1])
    log += np.log([[1.0 - share_moved], [share_moved]])
    share = np.exp(log - np.logaddexp(*log))
    information = np.einsum("kn,knij->nij", share, inverse)
    return Posterior(share, spread[:, None] @ inverse, spread, information)


@dataclass(frozen=True, eq=False)
class Poses:
    """One camera of one vehicle, in the results that have an error bar of it.

    Attributes:
        results: (n,) their places in the order given.
        base: (4, 4) T_camera_lidar of one in the middle; all twists are relative to it.
        twist: (n, 6) y_r, rotation [rad], translation [m], in the camera's axes.
        covariance: (n, 6, 6) P_r.
        information: (n, 6, 6) W_r of a regular one.
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


LimitsOf = Callable[[Array], Limits]
"""The limits of deviations with (n, 6) degrees of freedom."""


@dataclass(frozen=True, eq=False)
class Deviations:
    """How far each result of one camera is from the centre of the others.

    Attributes:
        pool: (n,) the results whose mean each is compared with, itself excepted.
        agreeing: (n,) the regular ones: the largest part found that agrees.
        ambiguous: (n, n) True where result s may have changed in place of result r.
        deviation, covariance, freedom: (n, 6), (n, 6, 6), (n, 6) of each from the pool's others.
    """

    poses: Poses
    pool: Mask
    agreeing: Mask
    ambiguous: Mask
    deviation: Array
    covariance: Array
    freedom: Array

    def coefficients(self, r: int) -> Array:
        """(n, 6, 6) derivative of the deviation of r by the twist of each result."""
        W = np.where((self.pool & (np.arange(len(self.pool)) != r))[:, None, None],
                     self.poses.information, 0.0)  # fmt: skip
        entering: Array = -np.linalg.inv(W.sum(axis=0)) @ W
        entering[r] = _EYE
        return entering


def compare(poses: Poses, limits: LimitsOf) -> Deviations:
    """Each result against the others that agree.

    The result that deviates most is removed from the mean of the others, until none that is left
    deviates. If no more than half are left, or the rest agrees as well with another result removed
    in place of this one, it is not known which of them changed: these are compared with each other.
    """
    agreeing = _agreeing(poses, limits)
    ambiguous = ~np.eye(len(poses), dtype=np.bool_)
    if 2 * np.count_nonzero(agreeing) > len(poses):
        ambiguous = _ambiguous_pairs(poses, agreeing, limits)
    pool = agreeing | ambiguous.any(axis=1)
    return Deviations(poses, pool, agreeing, ambiguous, *_leave_one_out(poses, pool))


def _leave_one_out(poses: Poses, kept: Mask) -> tuple[Array, Array, Array]:
    """Deviation of each result from the mean of the other kept ones, covariance, freedom."""
    W = np.where(kept[:, None, None], poses.information, 0.0)
    of_mean = np.linalg.inv(_sums_of_others(W))
    weighted = _sums_of_others(np.einsum("nij,nj->ni", W, poses.twist))
    covariance = poses.covariance + of_mean
    own = _variances(poses.covariance) / _variances(covariance)
    of_others = _sums_of_others(poses.freedom * kept)[:, None]
    freedom = 1 / (own**2 / poses.freedom[:, None] + (1 - own) ** 2 / of_others)
    return poses.twist - np.einsum("nij,nj->ni", of_mean, weighted), covariance, freedom


def _sums_of_others(values: Array) -> Array:
    """Per entry of the first axis, the sum of all others; exact where one is far the largest."""
    before, after = np.zeros_like(values), np.zeros_like(values)
    before[1:] = np.cumsum(values[:-1], axis=0)
    after[:-1] = np.cumsum(values[:0:-1], axis=0)[::-1]
    return before + after


def _agreeing(poses: Poses, limits: LimitsOf) -> Mask:
    """(n,) the results that are left, one at least."""
    kept = np.ones(len(poses), np.bool_)
    while np.count_nonzero(kept) > 1:
        deviation, covariance, freedom = _leave_one_out(poses, kept)
        beyond = kept & limits(freedom).exceeded(deviation, covariance).any(axis=1)
        if not beyond.any():
            break
        # Decrease of the chi-squared of the rest when each result is removed.
        solved = np.linalg.solve(covariance, deviation[..., None])[..., 0]
        less = np.einsum("ni,ni->n", deviation, solved)
        kept[np.argmax(np.where(beyond, less, -1.0))] = False
    return kept


def _ambiguous_pairs(poses: Poses, agreeing: Mask, limits: LimitsOf) -> Mask:
    """(n, n) pairs of a removed result and one that is left, where the rest agrees either way."""
    ambiguous = np.zeros((len(poses), len(poses)), np.bool_)
    for removed in np.flatnonzero(~agreeing):
        for left in np.flatnonzero(agreeing):
            swapped = agreeing.copy()
            swapped[[removed, left]] = True, False
            deviation, covariance, freedom = _leave_one_out(poses, swapped)
            beyond = swapped & limits(freedom).exceeded(deviation, covariance).any(axis=1)
            ambiguous[removed, left] = ambiguous[left, removed] = not beyond.any()
    return ambiguous


def _variances(covariance: Array) -> Array:
    """(n, 6) diagonals of (n, 6, 6) covariances."""
    return np.asarray(np.diagonal(covariance, axis1=1, axis2=2))
