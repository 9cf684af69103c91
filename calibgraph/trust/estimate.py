"""What is known of one camera's estimate, from a batch solve or while driving: input to checks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.calibration import Residuals
from calibgraph.model.config import Terms
from calibgraph.model.geometry import invert, relative_covariance, relative_transform
from calibgraph.model.rig import Camera, RelativePose
from factors import pose_sigmas

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Conflict:
    """The difference of a measured relative pose from the correspondences' estimate of it.

    Attributes:
        pair: the relative pose of the rig file.
        difference: (6,) tangent from measured to estimated T_a_b: rotation [rad], translation [m],
            along the axes of b.
        sigmas: (6,) standard deviations expected of it: the measurement's and the estimate's.
    """

    pair: RelativePose
    difference: Array
    sigmas: Array

    @property
    def largest(self) -> float:
        """The largest component of the difference, in its standard deviations."""
        return float(np.abs(self.difference / self.sigmas).max())


@dataclass(frozen=True, eq=False)
class Estimate:
    """One camera's estimate, with what its checks need.

    Attributes:
        camera: lens, and the initial guess.
        residuals: None if it had no correspondences and was solved through relative poses.
        used: correspondences in the final solve.
        frames: frames that they come from.
        covariance: (6, 6) of (rotation [rad], translation [m]), or None.
        data_sigmas: (6,) standard deviations if every correspondence were independent: rotation
            [rad], translation [m]; or None.
        halves: (4, 4) T_camera_lidar from the even and from the odd frames, or None.
        conflicts: of the relative poses that name this camera.
        pull: how far priors and relative poses pull it from its own solution [deg, cm]; None if
            nothing pulls, or by less than ``pull_sigmas`` of that solution.
        converged: whether the last pass stopped by its tolerance.
        terms: of the objective.
        held: whether nothing determines it.
    """

    camera: Camera
    residuals: Residuals | None
    used: int
    frames: int
    covariance: Array | None
    data_sigmas: Array | None
    halves: tuple[Array, Array] | None
    conflicts: tuple[Conflict, ...]
    pull: tuple[float, float] | None
    converged: bool
    terms: Terms
    held: bool = False

    @property
    def sigmas(self) -> Array | None:
        """(6,) standard deviations: rotation [rad], translation [m]; or None."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))


def relative_pose_conflict(
    pair: RelativePose,
    cameras: tuple[str, ...],
    T_camera_lidar: Mapping[str, Array],
    covariance: Array | None,
) -> Conflict:
    """The difference of a relative pose from an estimate, and the sigma expected of it.

    Args:
        pair: the measured relative pose.
        cameras: names in the order of the covariance.
        T_camera_lidar: per camera, (4, 4) from the correspondences alone.
        covariance: (6 N, 6 N) of these, or None.
    """
    estimated = relative_transform(T_camera_lidar[pair.a], T_camera_lidar[pair.b])
    difference = gtsam.Pose3.Logmap(gtsam.Pose3(invert(pair.T_a_b) @ estimated))
    variance = (
        pose_sigmas(rotation_rad=pair.rotation_sigma_rad, translation_m=pair.translation_sigma_m)
        ** 2
    )
    if covariance is not None:
        places = cameras.index(pair.a), cameras.index(pair.b)
        of_pair = relative_covariance(covariance, *places, invert(estimated))
        variance = variance + np.diag(of_pair)
    return Conflict(pair, difference, np.sqrt(variance))
