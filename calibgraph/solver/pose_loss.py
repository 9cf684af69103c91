"""How likely the true poses are under a solution, and how that changes with each correspondence.

The solution is the optimum of a graph, where the gradient b of the cost by the poses is zero. If a
correspondence k changes by d theta, the optimum moves by -H^-1 (d b_k / d theta) d theta, with H
the derivative of b by the poses: implicit differentiation, without unrolling the optimizer.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.graph.objective import join, projection_graph
from calibgraph.model.geometry import pose_rows, retract_all, to_T_lidar_camera
from calibgraph.solver.curvature import pose_hessian, robust_hessian
from calibgraph.solver.optimizer import optimize
from factors import ProjectionBlock
from factors.conditioning import invert_or_none

DEGREES = 6.0
"""Of freedom, of the errors' distribution: matches are not independent, as the Hessian takes them
to be, so errors have heavier tails."""

_STEP = 1e-3  # of a correspondence, in parts of the loss's scale and of the weight
_POSE_STEP = 1e-5  # rad and m


@dataclass(frozen=True, eq=False)
class PoseLoss:
    """The negative log-likelihood of true poses under a solution, and its gradient.

    Attributes:
        value: up to a constant.
        T_camera_lidar: per camera, (4, 4) of the solution.
        by_pixels: per camera, (n, 2) derivatives by the pixels of its correspondences [1/px].
        by_log_weights: per camera, (n,) by the logarithms of their weights, square roots of their
            information.
    """

    value: float
    T_camera_lidar: Mapping[str, Array]
    by_pixels: Mapping[str, Array]
    by_log_weights: Mapping[str, Array]


def pose_loss(
    blocks: Mapping[str, ProjectionBlock],
    others: gtsam.NonlinearFactorGraph,
    T_camera_lidar: Mapping[str, Array],
) -> PoseLoss:
    """Solve from the true poses, and differentiate.

    With xi the twists from the solution to the truth, H the information of its poses and N cameras,
    the likelihood is that of Student's t: (DEGREES + 6 N) / 2 log(1 + xi^T H xi / DEGREES)
    - log det(H) / 2.

    Args:
        blocks: per camera, its correspondences, with their loss.
        others: factors between poses and priors, on the variables of ``graph.objective.pose_key``.
        T_camera_lidar: per camera, (4, 4) the truth; in the order of the variables.

    Raises:
        CalibrationError: if the graph does not determine the poses.
    """
    cameras = list(T_camera_lidar)
    graph = join(projection_graph(cameras, blocks), others)
    found = optimize(graph, cameras, T_camera_lidar).T_camera_lidar
    poses = {name: to_T_lidar_camera(found[name]) for name in cameras}
    own = {name: block.sums(poses[name]).hessian for name, block in blocks.items()}
    between = pose_hessian(others, cameras, found)
    information = between + _on_diagonal(own, cameras)
    exact = {name: robust_hessian(block, poses[name]) for name, block in blocks.items()}
    inverses = invert_or_none(information), invert_or_none(between + _on_diagonal(exact, cameras))
    if inverses[0] is None or inverses[1] is None:
        raise CalibrationError("the correspondences and priors do not determine the poses")
    xi, inward = _error(poses, T_camera_lidar)
    pull = information @ xi
    squared = float(xi @ pull)
    spread = (DEGREES + len(xi)) / 2
    value = spread * np.log1p(squared / DEGREES) - np.linalg.slogdet(information)[1] / 2
    by_information = spread / (DEGREES + squared) * np.outer(xi, xi) - inverses[0] / 2
    by_pose = 2 * spread / (DEGREES + squared) * inward.T @ pull
    for name, block in blocks.items():
        rows = pose_rows(cameras.index(name))
        by_pose[rows] += _by_pose(block, found[name], by_information[rows, rows])
    along = -inverses[1] @ by_pose

    def gradient(name: str) -> Array:
        rows = pose_rows(cameras.index(name))
        return _by_data(blocks[name], poses[name], along[rows], by_information[rows, rows])

    gradients = {name: gradient(name) for name in blocks}
    return PoseLoss(
        float(value),
        found,
        {name: of[:, :2] for name, of in gradients.items()},
        {name: of[:, 2] for name, of in gradients.items()},
    )


def _on_diagonal(own: Mapping[str, Array], cameras: list[str]) -> Array:
    """(6 N, 6 N) with the (6, 6) of each camera."""
    whole = np.zeros((6 * len(cameras), 6 * len(cameras)))
    for name, hessian in own.items():
        rows = pose_rows(cameras.index(name))
        whole[rows, rows] = hessian
    return whole


def _error(
    poses: Mapping[str, gtsam.Pose3], T_camera_lidar: Mapping[str, Array]
) -> tuple[Array, Array]:
    """(6 N,) twists from the solution to the truth; (6 N, 6 N) derivative by a move of the former.

    Log((T exp(d))^-1 T') = Log(exp(-d) exp(xi)): the inverse left Jacobian at xi, which is the
    right one at -xi.
    """
    twists = [
        gtsam.Pose3.Logmap(pose.between(to_T_lidar_camera(T_camera_lidar[name])))
        for name, pose in poses.items()
    ]
    jacobian = np.zeros((6 * len(twists), 6 * len(twists)))
    for number, xi in enumerate(twists):
        rows = pose_rows(number)
        jacobian[rows, rows] = -gtsam.Pose3.LogmapDerivative(-xi)
    return np.concatenate(twists), jacobian


def _by_pose(block: ProjectionBlock, T_camera_lidar: Array, by_information: Array) -> Array:
    """(6,) derivative by a move of the pose of what the loss owes to the information there."""
    steps = _POSE_STEP * np.vstack([np.eye(6), -np.eye(6)])
    near = retract_all(np.tile(T_camera_lidar, (12, 1, 1)), steps)
    of = [np.sum(by_information * block.sums(to_T_lidar_camera(T)).hessian) for T in near]
    return (np.array(of[:6]) - np.array(of[6:])) / (2 * _POSE_STEP)


def _by_data(
    block: ProjectionBlock, T_lidar_camera: gtsam.Pose3, along: Array, by_information: Array
) -> Array:
    """(n, 3) derivatives by u, v and the logarithm of the weight of every correspondence."""
    alone = np.arange(len(block) + 1)

    def owed(changed: ProjectionBlock) -> Array:
        sums = changed.frame_sums(T_lidar_camera, alone)
        return np.asarray(
            sums.gradient @ along + np.einsum("ij,nij->n", by_information, sums.hessian)
        )

    step_px = _STEP * block.scale * block.sigma
    changes: list[tuple[Callable[[float], ProjectionBlock], float]] = [
        (lambda by: _moved(block, np.array([by, 0.0])), step_px),
        (lambda by: _moved(block, np.array([0.0, by])), step_px),
        (lambda by: _weighed(block, by), _STEP),
    ]
    return np.column_stack(
        [(owed(change(step)) - owed(change(-step))) / (2 * step) for change, step in changes]
    )


def _moved(block: ProjectionBlock, by_px: Array) -> ProjectionBlock:
    return ProjectionBlock(
        block.lens,
        block.points_lidar_m,
        block.pixels_px + by_px,
        block.sqrt_information,
        block.loss,
        block.scale,
        block.sigma,
    )


def _weighed(block: ProjectionBlock, log_weight: float) -> ProjectionBlock:
    root = block.sqrt_information
    root = np.tile([1.0, 0.0, 1.0], (len(block), 1)) if root is None else root
    return block.rewhiten(np.exp(log_weight) * root)
