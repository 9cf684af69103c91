"""Bodies: cameras whose relative poses are known, which are searched as one."""

from collections.abc import Mapping

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert, relative_transform
from calibgraph.model.rig import Camera, Rig

Body = Mapping[str, Camera]
"""Cameras with fixed relative poses; the extrinsic of the first is the pose of the body."""

RIGID_RAD, RIGID_M = np.radians(0.5), 0.1
"""Sigmas of a known relative pose up to which two cameras are one body; the rounds correct the
remaining error camera by camera."""


def rigid_bodies(rig: Rig) -> list[Body]:
    """The cameras of a rig in bodies, the first of each at its guess."""
    steps = [
        step
        for pair in rig.relative_poses
        if pair.rotation_sigma_rad <= RIGID_RAD and pair.translation_sigma_m <= RIGID_M
        for step in ((pair.a, pair.b, invert(pair.T_a_b)), (pair.b, pair.a, pair.T_a_b))
    ]
    left = dict(rig.cameras)
    bodies: list[Body] = []
    while left:
        name = next(iter(left))
        body = {name: left.pop(name)}
        while step := next((s for s in steps if s[0] in body and s[1] in left), None):
            known, new, T_new_known = step
            body[new] = left.pop(new).moved_to(T_new_known @ body[known].T_camera_lidar)
        bodies.append(body)
    return bodies


def lead(body: Body) -> Camera:
    """The camera whose extrinsic is the pose of the body."""
    return next(iter(body.values()))


def place(body: Body, T_lead_lidar: Array) -> Body:
    """The body with its lead at an extrinsic."""
    old = lead(body).T_camera_lidar
    return {
        name: camera.moved_to(relative_transform(camera.T_camera_lidar, old) @ T_lead_lidar)
        for name, camera in body.items()
    }


def place_member(body: Body, name: str, T_camera_lidar: Array) -> Body:
    """The body with one of its cameras at an extrinsic."""
    T_lead_member = relative_transform(lead(body).T_camera_lidar, body[name].T_camera_lidar)
    return place(body, T_lead_member @ T_camera_lidar)


def adjoint(body: Body, name: str) -> Array:
    """(6, 6) a twist in the lead's axes to the same in a camera's."""
    T = relative_transform(body[name].T_camera_lidar, lead(body).T_camera_lidar)
    return np.asarray(gtsam.Pose3(T).AdjointMap())
