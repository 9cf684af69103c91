"""Where the graph of the error model had its optimum when the last epoch closed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.variables import (
    CLOUD,
    DISTORTION,
    cloud_at_key,
    matched_at_key,
    matched_key,
)
from calibgraph.solver.elimination import start_values


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
        for place, camera in model.matched_places:
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
        self, model: LatentPoseModel, names: Sequence[str], guess: Mapping[str, Array]
    ) -> gtsam.Values:
        """Values of all variables of a model, near its optimum.

        Places that are new are where they are expected; cameras that are, at a guess.

        Args:
            model: with these or other places.
            names: of its places.
            guess: per camera, (4, 4) T_camera_lidar.
        """
        values, known = start_values(model, guess), dict(self.shared)
        for place, name in enumerate(names):
            known[cloud_at_key(place)] = self.clouds.get(name, self.shared[CLOUD])
        for place, camera in model.matched_places:
            expected = self.shared.get(matched_key(camera), values.atPose3(matched_key(camera)))
            of_place = self.matched.get(names[place], {})
            known[matched_at_key(place, camera)] = of_place.get(camera, expected)
        for key, pose in known.items():
            if values.exists(key):
                values.update(key, pose)
        if model.is_distorted and self.distortion is not None:
            values.update(DISTORTION, self.distortion)
        return values

    def pose_at(self, name: str, camera: int) -> gtsam.Pose3 | None:
        """T_lidar_camera as a camera's matches at a place show it; None if it was never there."""
        if camera not in self.matched.get(name, {}):
            return None
        return self.clouds[name].between(self.matched[name][camera])
