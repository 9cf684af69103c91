"""Where the graph of the error model had its optimum when the last epoch closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.variables import (
    CLOUD,
    DISTORTION,
    aligned_key,
    camera_key,
    cloud_at_key,
    matched_at_key,
    matched_key,
)


@dataclass(frozen=True, eq=False)
class Optimum:
    """Values of the variables of ``calibgraph.graph.variables``, by names of places.

    Attributes:
        shared: by key, of what all places share but the scan distortion.
        distortion: in standard deviations of its prior, or None.
        clouds: per place, ``o_p``.
        matched: per place and camera (by its place in the rig), ``a_cp``.
        contradicting: places in ``rig.relative_poses`` of those that take no part.
    """

    shared: Mapping[int, gtsam.Pose3]
    distortion: Array | None
    clouds: Mapping[str, gtsam.Pose3]
    matched: Mapping[str, Mapping[int, gtsam.Pose3]]
    contradicting: tuple[int, ...]

    @staticmethod
    def of(
        model: LatentPoseModel,
        values: gtsam.Values,
        names: Sequence[str],
        contradicting: tuple[int, ...],
    ) -> Optimum:
        """Of a model of places of some names."""
        matched: dict[str, dict[int, gtsam.Pose3]] = {name: {} for name in names}
        for place, camera in model.matched_places():
            matched[names[place]][camera] = values.atPose3(matched_at_key(place, camera))
        return Optimum(
            {key: values.atPose3(key) for key in model.shared_keys if key != DISTORTION},
            values.atVector(DISTORTION) if model.is_distorted else None,
            {name: values.atPose3(cloud_at_key(place)) for place, name in enumerate(names)},
            matched,
            contradicting,
        )

    def updated(self, newer: Optimum) -> Optimum:
        """With the poses of another optimum where it has some, the same relative poses left out."""
        return Optimum(
            {**self.shared, **newer.shared},
            newer.distortion,
            {**self.clouds, **newer.clouds},
            {**self.matched, **newer.matched},
            self.contradicting,
        )

    def values(
        self, model: LatentPoseModel, names: Sequence[str], guess: Sequence[gtsam.Pose3]
    ) -> gtsam.Values:
        """Values of all variables of a model, near its optimum.

        Places that are new are where they are expected; cameras that are, at a guess.

        Args:
            model: with these or other places.
            names: of its places.
            guess: per camera, T_lidar_camera.
        """
        values, cloud = gtsam.Values(), self.shared[CLOUD]
        values.insert(CLOUD, cloud)
        for camera, pose in enumerate(guess):
            values.insert(camera_key(camera), self.shared.get(camera_key(camera), pose))
        keys = {aligned_key(camera): camera for camera in model.aligned}
        keys |= {matched_key(camera): camera for camera in model.matched}
        for key, camera in keys.items():
            values.insert(key, self.shared.get(key, guess[camera]))
        for place, name in enumerate(names):
            values.insert(cloud_at_key(place), self.clouds.get(name, cloud))
        for place, camera in model.matched_places():
            expected = values.atPose3(matched_key(camera))
            pose = self.matched.get(names[place], {}).get(camera, expected)
            values.insert(matched_at_key(place, camera), pose)
        if model.is_distorted:
            size = model.components.distortion_jacobian.shape[2]
            values.insert(
                DISTORTION, np.zeros(size) if self.distortion is None else self.distortion
            )
        return values

    def pose_at(self, name: str, camera: int) -> gtsam.Pose3 | None:
        """T_lidar_camera as a camera's matches at a place show it; None if it was never there."""
        if camera not in self.matched.get(name, {}):
            return None
        return self.clouds[name].inverse().compose(self.matched[name][camera])
