"""An objective at extrinsics that fit it: what covariances and error models are computed from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import gtsam

from calibgraph.model.geometry import to_T_lidar_camera
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

    def data_only(self) -> FittedObjective:
        """The correspondences alone, at their minimum near here."""
        free = self.objective.data_only()
        start = {name: self.T_camera_lidar[name] for name in free.cameras}
        return FittedObjective(free, self.scales, free.minimize(start, self.scales).T_camera_lidar)
