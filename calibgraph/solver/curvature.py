"""An objective at extrinsics that fit it, and the second derivatives of its cost there.

Covariances and error models are computed from these: of the correspondences, and of all terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.camera_pairs import PairTerm
from calibgraph.solver.objective import Objective, Scales, Transforms
from calibgraph.solver.optimizer import to_values
from factors import BlockSums, ProjectionBlock


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


def robust_hessians(sums: BlockSums) -> Array:
    """(f, 6, 6) second derivatives of half the robust cost of frames, by their sums.

    Where it is not convex, the reweighted Hessian, which is positive semidefinite.

    Args:
        sums: with the curvature, of (f) frames.
    """
    assert sums.curvature is not None
    if _is_positive_definite(sums.curvature):
        return sums.curvature
    return np.array([*map(convex_hessian, sums.curvature, sums.hessian)])


def robust_hessian(sums: BlockSums) -> Array:
    """(6, 6) the same of all frames together."""
    assert sums.curvature is not None
    return convex_hessian(sums.curvature.sum(axis=0), sums.hessian.sum(axis=0))


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
    def frame_sums(self) -> Mapping[str, BlockSums]:
        """Per camera with correspondences, the sums of its frames; empty without terms."""
        if not self.objective.uses_correspondences:
            return {}
        edges = {name: block.frame_edges for name, block in self.objective.blocks.items()}
        return {
            name: block.frame_sums(self.pose(name), edges[name], curvature=True)
            for name, block in self.projections.items()
        }

    @cached_property
    def robust_hessians(self) -> Mapping[str, Array]:
        """Per camera with correspondences, their (6, 6) :func:`robust_hessian`."""
        return {name: robust_hessian(sums) for name, sums in self.frame_sums.items()}

    def data_only(self) -> FittedObjective:
        """The correspondences alone, at their minimum near here."""
        free = self.objective.data_only()
        start = {name: self.T_camera_lidar[name] for name in free.cameras}
        return FittedObjective(free, self.scales, free.minimize(start, self.scales).T_camera_lidar)
