"""Deviations from a common centre: regular ones of one spread, and a few that were moved.

A measured deviation y = d + e has the noise of its measurement, e ~ N(0, V_e), and is either
regular, d ~ N(0, S), or moved, d ~ N(0, M) with a much larger M. Everything that a level of the
fleet needs follows from both posteriors: the shrunk deviations with their error bars, how likely
each was moved, the information about the centre, and the second moments from which EM learns S.

The centres are a factor graph: a camera's nominal pose, and the poses of its batches, all
``T_lidar_camera``. The vehicles of a batch are one factor: their information about its centre adds
up, 27 numbers per camera and batch.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import retract_all, to_T_camera_lidar, to_T_lidar_camera

_EYE = np.eye(6)


@dataclass(frozen=True, eq=False)
class Posterior:
    """Deviations given their measurements; arrays of two have the regular case first.

    Attributes:
        share: (2, n) probability of each case.
        gain: (2, n, 6, 6) what of a measured deviation is believed.
        spread: (2, 6, 6) covariance of the deviations of each case.
        information: (n, 6, 6) of the measurement about the centre.
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


_NOMINAL = 0  # key; those of the batches follow


@dataclass(frozen=True, eq=False)
class Centers:
    """Where a camera sits in a model and in each of its batches.

    Attributes:
        nominal: (4, 4) T_camera_lidar of the model.
        nominal_covariance: (6, 6) of xi in T_camera_lidar = exp(xi) estimate.
        batches: (b, 4, 4).
        batch_covariance: (b, 6, 6).
    """

    nominal: Array
    nominal_covariance: Array
    batches: Array
    batch_covariance: Array


def measured_batches(
    batches: Array, information: Array, weighted: Array
) -> tuple[NDArray[np.intp], Array, Array]:
    """What the vehicles alone measure of their batches' centres.

    Args:
        batches: (b, 4, 4) T_camera_lidar from which deviations are counted.
        information: (b, 6, 6) sums over the vehicles.
        weighted: (b, 6) sums of information times deviation.

    Returns:
        (m,) the batches that have any; (m, 4, 4) measured; (m, 6, 6) covariances.
    """
    some = np.flatnonzero(np.trace(information, axis1=1, axis2=2) > 0)
    covariance = np.linalg.inv(information[some])
    covariance = (covariance + covariance.swapaxes(1, 2)) / 2
    steps = np.einsum("bij,bj->bi", covariance, weighted[some])
    return some, retract_all(batches[some], -steps), covariance


def solve_centers(
    start: Centers, measured: tuple[NDArray[np.intp], Array, Array], spread: Array
) -> Centers:
    """The optimum of the graph, with its marginal covariances."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(_NOMINAL, to_T_lidar_camera(start.nominal))
    for batch, (T, between) in enumerate(zip(start.batches, spread, strict=True), start=1):
        values.insert(batch, to_T_lidar_camera(T))
        noise = gtsam.noiseModel.Gaussian.Covariance(between)
        graph.add(gtsam.BetweenFactorPose3(_NOMINAL, batch, gtsam.Pose3(), noise))
    for batch, T, covariance in zip(*measured, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorPose3(int(batch) + 1, to_T_lidar_camera(T), noise))
    optimum = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, optimum)
    keys = range(len(start.batches) + 1)
    T = np.array([to_T_camera_lidar(optimum.atPose3(key)) for key in keys])
    bars = np.array([marginals.marginalCovariance(key) for key in keys])
    return Centers(T[0], bars[0], T[1:], bars[1:])
