"""What the matches of a drive's cameras have to do with the bends of the cloud, in sums of epochs.

Within an epoch each camera has a pose of its own at each place. What no such pose can follow is
left in the residuals, at whatever estimate: so these sums need no reference, and hold on when a
camera moves or drifts. See ``calibgraph.solver.scan_distortion``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, merge
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.solver.scan_distortion import distortion_evidence
from calibgraph.solver.within_place import WEAK

Array = NDArray[np.float64]

_BENDS = 3


@dataclass(frozen=True, eq=False)
class BendSums:
    """Per camera the sums over epochs of ``distortion_evidence`` (``solver.scan_distortion``).

    Attributes:
        hessian: (n, 6, 6) of independent matches.
        pull: (n, 6, 3) the same times the shift of the pose by a unit of each bend.
        information: (n, 3, 3) of the residuals about the bends, if all were independent.
        vector: (n, 3) the information times the bends that these show.
    """

    hessian: Array
    pull: Array
    information: Array
    vector: Array

    @staticmethod
    def empty(cameras: int) -> BendSums:
        """Over no epochs."""
        shapes = (6, 6), (6, _BENDS), (_BENDS, _BENDS), (_BENDS,)
        return BendSums(*(np.zeros((cameras, *shape)) for shape in shapes))

    @property
    def shifts(self) -> Array:
        """(n, 6, 3) by how much the poses follow a unit of each bend; 0 without matches."""
        return np.asarray(np.linalg.solve(self.hessian + WEAK, self.pull))

    def __add__(self, other: BendSums) -> BendSums:
        return BendSums(
            self.hessian + other.hessian,
            self.pull + other.pull,
            self.information + other.information,
            self.vector + other.vector,
        )

    def at_new_pose(self, camera: int) -> BendSums:
        """The sums after a camera has moved: its matches follow the bends in another way now."""
        hessian, pull = self.hessian.copy(), self.pull.copy()
        hessian[camera], pull[camera] = 0.0, 0.0
        return replace(self, hessian=hessian, pull=pull)

    def with_epoch(
        self,
        camera: int,
        parts: Sequence[CameraBlock],
        places: Sequence[NDArray[np.int64]],
        scale: ResidualScale,
        T_lidar_camera: gtsam.Pose3,
    ) -> BendSums:
        """The sums with those of a camera replaced by those of one epoch.

        Args:
            camera: by its place in the rig.
            parts: its matches, frame by frame.
            places: the numbers of the epoch's frames at each place.
            scale: of their residuals.
            T_lidar_camera: its estimate.
        """
        found = BendSums(*(values.copy() for values in vars(self).values()))
        for values in vars(found).values():
            values[camera] = 0.0
        if not parts:
            return found
        raw = merge(parts)
        inliers = raw.select(raw.at(to_T_camera_lidar(T_lidar_camera)).inliers(scale))
        if len(inliers.frame) < MIN_MATCHES:
            return found
        evidence = distortion_evidence(inliers, scale, T_lidar_camera, WEAK, places=places)
        found.hessian[camera] = evidence.hessian
        found.pull[camera] = evidence.hessian @ evidence.jacobian
        found.information[camera] = evidence.information.sum(axis=0)
        found.vector[camera] = evidence.vector.sum(axis=0)
        return found
