"""How the matches of a drive's cameras follow the bends of the cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, merge
from calibgraph.solver.cloud_bends import bend_evidence
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.solver.within_place import WEAK

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class BendShifts:
    """Per camera the mean over epochs of :func:`calibgraph.solver.cloud_bends.bend_evidence`.

    Attributes:
        mean: (n, 6, 3) by a unit of each bend; 0 before a camera has started.
        epochs: (n,) of how many.
    """

    mean: Array
    epochs: Array

    @staticmethod
    def unknown(cameras: int) -> BendShifts:
        """Of no frames."""
        return BendShifts(np.zeros((cameras, 6, 3)), np.zeros(cameras))

    def add(
        self,
        camera: int,
        parts: Sequence[CameraBlock],
        scale: ResidualScale,
        T_lidar_camera: gtsam.Pose3,
    ) -> BendShifts:
        """The mean with a camera's frames of an epoch.

        Args:
            camera: by its place in the rig.
            parts: its matches, frame by frame.
            scale: of their residuals.
            T_lidar_camera: its estimate.
        """
        if not parts:
            return self
        raw = merge(parts)
        inliers = raw.select(raw.at(to_T_camera_lidar(T_lidar_camera)).inliers(scale))
        if len(inliers.frame) < MIN_MATCHES:
            return self
        mean, epochs = self.mean.copy(), self.epochs.copy()
        epochs[camera] += 1
        found = bend_evidence(
            inliers, scale, T_lidar_camera, WEAK, [np.unique(inliers.frame)]
        ).shifts
        mean[camera] += (found - mean[camera]) / epochs[camera]
        return BendShifts(mean, epochs)
