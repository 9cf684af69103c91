"""The factor graph: one small graph per kind of factor; :func:`objective_graph` is all of Eq. 5.

The variables are ``T_lidar_camera``, one ``Pose3`` per camera: in this direction GTSAM's stock
prior and between factors are the paper's terms.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

import gtsam

from calibgraph.arrays import Array
from calibgraph.graph.variables import camera_key
from calibgraph.model.config import Config, Terms
from calibgraph.model.geometry import relative_transform
from calibgraph.model.rig import Rig
from factors import (
    ProjectionBlock,
    block_factor,
    camera_prior_factor,
    projection_factor,
    relative_pose_factor,
    relative_prior_factor,
)

# fmt: off
__all__ = [  # with the factors that calibgraph re-exports
    "block_factor", "camera_prior_factor", "join", "objective_graph", "pose_key",
    "projection_factor", "projection_graph", "relative_pose_factor",
    "relative_prior_factor",
]
# fmt: on


def pose_key(cameras: Sequence[str], name: str) -> int:
    """GTSAM key of a camera's variable ``T_lidar_camera``."""
    return camera_key(cameras.index(name))


def projection_graph(
    cameras: Sequence[str], blocks: Mapping[str, ProjectionBlock]
) -> gtsam.NonlinearFactorGraph:
    """The reprojection term: one lossless block factor per camera that has correspondences."""
    return _graph(block_factor(pose_key(cameras, name), block) for name, block in blocks.items())


# fmt: off
def objective_graph(
    rig: Rig,
    blocks: Mapping[str, ProjectionBlock],
    T_hat: Mapping[str, Array],
    config: Config,
    *, terms: Terms,
) -> gtsam.NonlinearFactorGraph:
    """The whole objective (paper, Eq. 5), and the measured relative poses of the rig.

    ``print(graph)`` lists every factor; variable ``x0`` is the first camera of the rig, ``x1`` the
    second. ``2 * graph.error(values)`` is the paper's cost, since GTSAM halves squared errors.

    Args:
        rig: its cameras are the variables; its ``relative_poses`` are measurements, no term of the
            paper.
        blocks: per camera with correspondences; its scale and sigma are those of the loss.
        T_hat: per camera with a Stage-1 estimate, (4, 4) T_camera_lidar.
        config: lambda and mu.
        terms: which terms of Eq. 5 take part; with ``priors`` and ``stage1``, the priors alone.
    """
    cameras = list(rig.cameras)
    lambda_, mu = config.prior_weight, config.relative_prior_weight
    if terms == "reprojection":
        lambda_ = mu = 0.0
    if terms in ("priors", "stage1"):
        blocks = {}
    key = {name: pose_key(cameras, name) for name in cameras}
    return join(                                              # minimize over T_1 ... T_N:
        projection_graph(cameras, blocks),                    # sum rho(|w (u - pi(T_i, p))|^2)
        _graph(relative_pose_factor(                          # + measured relative poses (ours)
                   key[one.a], key[one.b], one.T_a_b, rotation_sigma_rad=one.rotation_sigma_rad,
                   translation_sigma_m=one.translation_sigma_m) for one in rig.relative_poses),
        _graph(camera_prior_factor(key[i], T, weight=lambda_)  # + lambda sum |log(T_hat^-1 T)|^2
               for i, T in T_hat.items() if lambda_ > 0),
        _graph(relative_prior_factor(                         # + mu |log(T_hat_12^-1 T_2 T_1^-1)|^2
                   key[i], key[j], relative_transform(T_hat[j], T_hat[i]), weight=mu)
               for i, j in pairwise(T_hat) if mu > 0),        # of each camera and the next
    )
# fmt: on


def _graph(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def join(*graphs: gtsam.NonlinearFactorGraph) -> gtsam.NonlinearFactorGraph:
    """One graph with the factors of all."""
    graph = gtsam.NonlinearFactorGraph()
    for part in graphs:
        graph.push_back(part)
    return graph
