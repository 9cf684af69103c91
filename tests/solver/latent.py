"""The error model's values: stacked, and as GTSAM has them."""

import gtsam
import numpy as np

from calibgraph.graph.latent_poses import LatentPoseModel
from calibgraph.graph.variables import (
    DISTORTION,
    aligned_key,
    camera_key,
    cloud_at_key,
    matched_at_key,
)
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.solver.places import ErrorFit, Linearization


def all_values(linear: Linearization) -> gtsam.Values:
    """Of all variables of the graph that is printed."""
    values, (clouds, *cameras) = gtsam.Values(linear.shared), linear.inverses
    for place, T in enumerate(clouds):
        values.insert(cloud_at_key(place), to_T_lidar_camera(T))
    for place, number in linear.model.matched_places:
        T = cameras[linear.model.matched.index(number)][place]
        values.insert(matched_at_key(place, number), to_T_lidar_camera(T))
    for number, jacobian in enumerate(linear.model.alignment):
        if linear.model.is_distorted:
            mount = values.atPose3(camera_key(number))
            values.insert(
                aligned_key(number), mount.retract(jacobian @ values.atVector(DISTORTION))
            )
    return values


def reported_keys(fit: ErrorFit) -> list[int]:
    """Keys of the poses that are reported."""
    is_mount = fit.is_of_mount or fit.model.of == "mount" or not fit.model.is_distorted
    return [*map(camera_key if is_mount else aligned_key, range(len(fit.model.cameras)))]


def linearized(model: LatentPoseModel, values: gtsam.Values) -> Linearization:
    """At values of all variables."""
    none, places = gtsam.Pose3(), range(model.places)
    keys = [[*map(cloud_at_key, places)]]
    keys += [[matched_at_key(place, number) for place in places] for number in model.matched]
    poses = [[values.atPose3(k) if values.exists(k) else none for k in row] for row in keys]
    shared = gtsam.Values(values)
    for key in {*values.keys()} - {*model.columns}:
        shared.erase(key)
    inverses = np.array([[to_T_camera_lidar(pose) for pose in row] for row in poses])
    return Linearization(model, shared, inverses)
