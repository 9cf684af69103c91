"""An objective at extrinsics that fit it, and the second derivatives of its cost there.

Covariances and error models are computed from these: of the correspondences, and of all terms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import retract_all, to_T_camera_lidar, to_T_lidar_camera
from calibgraph.parallel import map_on_cores
from calibgraph.solver.camera_pairs import PairTerm
from calibgraph.solver.objective import Objective, Scales, Transforms
from calibgraph.solver.optimizer import to_values
from factors import ProjectionBlock

_STEP = 1e-5  # rad and m: of the central differences of the gradient
_STEPS = _STEP * np.vstack([np.eye(6), -np.eye(6)])


def convex_hessian(hessian: Array, otherwise: Array) -> Array:
    """The Hessian if it is positive definite; few matches near the gate may spoil it."""
    return hessian if _is_positive_definite(hessian) else otherwise


def positive_part(matrix: Array) -> Array:
    """The positive semidefinite matrix nearest to a symmetric one."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _is_positive_definite(hessian: Array) -> bool:
    try:
        np.linalg.cholesky(hessian)
    except np.linalg.LinAlgError:
        return False
    return True


def add_pair_hessians(
    hessian: Array, pairs: Sequence[PairTerm], T_camera_lidar: Mapping[str, Array]
) -> None:
    """Add the part of camera pairs to the joint Hessian, (6 N, 6 N)."""
    for pair in pairs:
        rows = rows_of_pair(list(T_camera_lidar), pair)
        hessian[np.ix_(rows, rows)] += pair.sums(T_camera_lidar).hessian


def rows_of_pair(cameras: Sequence[str], pair: PairTerm) -> NDArray[np.intp]:
    """(12,) rows of A's pose, then of B's."""
    first = [6 * cameras.index(name) for name in (pair.a, pair.b)]
    return np.add.outer(first, np.arange(6)).ravel()


def pose_hessian(
    graph: gtsam.NonlinearFactorGraph, cameras: Sequence[str], T_camera_lidar: Mapping[str, Array]
) -> Array:
    """(6 N, 6 N) Gauss-Newton Hessian of the factors between poses."""
    return pose_equations(graph, cameras, T_camera_lidar)[0]


def pose_equations(
    graph: gtsam.NonlinearFactorGraph, cameras: Sequence[str], T_camera_lidar: Mapping[str, Array]
) -> tuple[Array, Array]:
    """(6 N, 6 N) Gauss-Newton Hessian and (6 N,) gradient of the factors between poses."""
    hessian, gradient = np.zeros((6 * len(cameras), 6 * len(cameras))), np.zeros(6 * len(cameras))
    if not graph.size():
        return hessian, gradient
    values = to_values(cameras, T_camera_lidar)
    keys = list(values.keys())
    for index in range(graph.size()):
        factor = graph.at(index).linearize(values)
        A, right = factor.jacobian()
        rows = np.concatenate([6 * keys.index(key) + np.arange(6) for key in list(factor.keys())])
        hessian[np.ix_(rows, rows)] += A.T @ A
        gradient[rows] -= A.T @ right
    return hessian, gradient


def robust_hessian(block: ProjectionBlock, T_lidar_camera: gtsam.Pose3) -> Array:
    """(6, 6) derivative of the gradient of half the robust cost, by central differences.

    Where the robust cost is not convex, the reweighted Hessian, which is positive semidefinite.

    Args:
        block: correspondences of one camera.
        T_lidar_camera: where; the Hessian is in its tangent.
    """
    gradients = block.gradients_at_each(_steps_from(T_lidar_camera))[None]
    return np.asarray(_convex(gradients, lambda: block.sums(T_lidar_camera).hessian[None])[0])


def robust_hessians_of(
    block: ProjectionBlock, T_lidar_camera: gtsam.Pose3, sums: Array, runs: NDArray[np.int64]
) -> Array:
    """(r, 6, 6) :func:`robust_hessian` of each of (r, 2) runs, whose reweighted ones are known."""
    gradients = block.run_gradients_at_each(_steps_from(T_lidar_camera), runs)
    return _convex(gradients, lambda: sums)


def _steps_from(T_lidar_camera: gtsam.Pose3) -> Array:
    return retract_all(np.tile(to_T_camera_lidar(T_lidar_camera), (12, 1, 1)), _STEPS)


def _convex(gradients: Array, reweighted: Callable[[], Array]) -> Array:
    """(r, 6, 6) by (r, 12, 6) gradients to both sides; the other where it is not convex."""
    halves: Array = (gradients[:, :6] - gradients[:, 6:]) / (4 * _STEP)
    hessians = halves + halves.swapaxes(1, 2)
    if not _is_positive_definite(hessians):
        return np.array([*map(convex_hessian, hessians, reweighted())])
    return hessians


@dataclass(frozen=True, eq=False)
class FittedObjective:
    """An objective, its scales, and the extrinsics where it is examined.

    Attributes:
        objective: after the gate.
        scales: of the residuals.
        T_camera_lidar: (4, 4) of all cameras: its minimum.
        held: cameras that nothing determines; they are known to a radian and a metre.
    """

    objective: Objective
    scales: Scales
    T_camera_lidar: Transforms
    held: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the order of the extrinsics."""
        return tuple(self.T_camera_lidar)

    def pose(self, camera: str) -> gtsam.Pose3:
        """T_lidar_camera of a camera, the variable of the graph."""
        return to_T_lidar_camera(self.T_camera_lidar[camera])

    @cached_property
    def projections(self) -> Mapping[str, ProjectionBlock]:
        """Per camera with correspondences, these with their scale."""
        return {n: b.with_scale(self.scales[n]) for n, b in self.objective.blocks.items()}

    @cached_property
    def robust_hessians(self) -> Mapping[str, Array]:
        """Per camera with correspondences, their (6, 6) `robust_hessian`; empty without terms."""
        if not self.objective.uses_correspondences:
            return {}
        blocks = self.projections
        hessians = map_on_cores(robust_hessian, [*blocks.values()], [self.pose(n) for n in blocks])
        return dict(zip(blocks, hessians, strict=True))

    @cached_property
    def frame_gradients(self) -> Mapping[str, Array]:
        """Per camera with correspondences, (f, 6) gradients of half the cost of its frames."""
        blocks = self.objective.blocks
        return {n: b.frame_gradients(self.pose(n), self.scales[n]) for n, b in blocks.items()}

    def data_only(self) -> FittedObjective:
        """The correspondences alone, at their minimum near here."""
        free = self.objective.data_only()
        start = {name: self.T_camera_lidar[name] for name in free.cameras}
        return FittedObjective(free, self.scales, free.minimize(start, self.scales).T_camera_lidar)
