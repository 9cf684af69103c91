"""The centres of a fleet as a factor graph: a camera's nominal pose, and its batches' poses.

The variables are ``T_lidar_camera``. The vehicles of a batch are one factor: their information
about the batch's centre adds up, 27 numbers per camera and batch, wherever the vehicles are held.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import retract_all, to_T_camera_lidar, to_T_lidar_camera

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
