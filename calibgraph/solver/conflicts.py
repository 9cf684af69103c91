"""Measured relative poses beside the correspondences' own."""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert, relative_covariance, relative_transform
from calibgraph.model.rig import RelativePose
from factors import pose_sigmas


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


def relative_pose_conflict(
    pair: RelativePose,
    cameras: tuple[str, ...],
    T_camera_lidar: Mapping[str, Array],
    covariance: Array,
) -> Conflict:
    """The difference of a relative pose from an estimate, and the sigma expected of it.

    Args:
        pair: the measured relative pose.
        cameras: names in the order of the covariance.
        T_camera_lidar: per camera, (4, 4) from the correspondences alone.
        covariance: (6 N, 6 N) of these.
    """
    estimated = relative_transform(T_camera_lidar[pair.a], T_camera_lidar[pair.b])
    difference = gtsam.Pose3.Logmap(gtsam.Pose3(invert(pair.T_a_b) @ estimated))
    sigmas = pair.rotation_sigma_rad, pair.translation_sigma_m
    own = pose_sigmas(rotation_rad=sigmas[0], translation_m=sigmas[1]) ** 2
    places = cameras.index(pair.a), cameras.index(pair.b)
    of_pair = relative_covariance(covariance, *places, invert(estimated))
    return Conflict(pair, difference, np.sqrt(own + np.diag(of_pair)))
