"""GTSAM's Levenberg-Marquardt on a graph of the cameras' poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import gtsam

from calibgraph.arrays import Array
from calibgraph.graph.objective import pose_key
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera

MAX_ITERATIONS = 200
"""Of Levenberg-Marquardt."""

RELATIVE_TOLERANCE = 1e-10
"""Relative change of the error at which it stops."""


@dataclass(frozen=True)
class Optimum:
    """The result of Levenberg-Marquardt.

    Attributes:
        T_camera_lidar: per camera, (4, 4).
        cost: the paper's objective there (twice GTSAM's error).
        iterations: of LM.
        converged: whether it stopped by its tolerance.
    """

    T_camera_lidar: dict[str, Array]
    cost: float
    iterations: int
    converged: bool


def to_values(cameras: Sequence[str], T_camera_lidar: Mapping[str, Array]) -> gtsam.Values:
    """GTSAM values of the extrinsics, (4, 4) T_camera_lidar of every camera."""
    values = gtsam.Values()
    for name in cameras:
        values.insert(pose_key(cameras, name), to_T_lidar_camera(T_camera_lidar[name]))
    return values


def optimize(
    graph: gtsam.NonlinearFactorGraph,
    cameras: Sequence[str],
    T_camera_lidar: Mapping[str, Array],
) -> Optimum:
    """Minimize a graph by Levenberg-Marquardt.

    Args:
        graph: over the variables of the cameras.
        cameras: their names, in the order of the variables.
        T_camera_lidar: (4, 4) per camera, the start.
    """
    start = to_values(cameras, T_camera_lidar)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, _parameters())
    values = optimizer.optimize()
    found = {name: to_T_camera_lidar(values.atPose3(pose_key(cameras, name))) for name in cameras}
    iterations = int(optimizer.iterations())
    return Optimum(found, 2.0 * optimizer.error(), iterations, iterations < MAX_ITERATIONS)


@cache
def _parameters() -> gtsam.LevenbergMarquardtParams:
    """Of Levenberg-Marquardt, which copies them."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(MAX_ITERATIONS)
    parameters.setRelativeErrorTol(RELATIVE_TOLERANCE)
    parameters.setAbsoluteErrorTol(0.0)
    return parameters
