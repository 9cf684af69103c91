"""An objective at extrinsics that fit it: what covariances and error models are computed from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.objective import relative_pose_graph
from calibgraph.model.geometry import pose_rows, to_T_lidar_camera
from calibgraph.parallel import map_on_cores
from calibgraph.solver.curvature import (
    Curvature,
    add_pair_hessians,
    convex_hessian,
    pose_hessian,
    robust_hessian,
    unknown,
)
from calibgraph.solver.objective import Objective, Scales, Transforms
from factors import ProjectionBlock


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

    @cached_property
    def curvature(self) -> Curvature:
        """The curvature of all terms, the gate's own among them."""
        inliers, cameras, T_camera_lidar = self.objective, self.cameras, self.T_camera_lidar
        own = np.zeros((6 * len(cameras), 6 * len(cameras)))
        for name, hessian in self.robust_hessians.items():
            rows = pose_rows(cameras.index(name))
            own[rows, rows] = convex_hessian(hessian + inliers.gate_hessian.get(name, 0.0), hessian)
        measured = relative_pose_graph(cameras, inliers.rig.relative_poses)
        whole = own + pose_hessian(inliers.pose_graph, cameras, T_camera_lidar)
        add_pair_hessians(whole, inliers.pairs, T_camera_lidar)
        whole += unknown([name in self.held for name in cameras])
        return Curvature(own, pose_hessian(measured, cameras, T_camera_lidar), whole)

    def data_only(self) -> FittedObjective:
        """The correspondences alone, at their minimum near here."""
        free = self.objective.data_only()
        start = {name: self.T_camera_lidar[name] for name in free.cameras}
        return FittedObjective(free, self.scales, free.minimize(start, self.scales).T_camera_lidar)
