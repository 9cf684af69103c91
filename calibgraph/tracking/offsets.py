"""The time offset of each camera, where it is estimated while driving.

It is the variable of ``calibgraph.graph.lens`` with the part ``offset`` alone, and a random walk:
a closed epoch shows the offset as it was then. Matches that are kept have their points where they
were at the present offset, so that all else sees an image and a cloud of one time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.lens import LensVariable
from calibgraph.model.clock import clock_of
from calibgraph.model.config import Config
from calibgraph.model.geometry import adjoint_camera_lidar
from calibgraph.model.rig import Camera, Rig
from calibgraph.solver.camera_block import CameraBlock


def require_offset_alone(config: Config) -> None:
    """Refuse settings that a tracker cannot follow.

    Raises:
        ValueError: if another part of the lens is to be estimated, or not with the preset ``auto``.
    """
    if config.estimate not in ((), ("offset",)):
        found = ", ".join(config.estimate)
        raise ValueError(f"while driving, offset alone can be estimated; found {found}")
    if config.estimate and config.preset != "auto":
        raise ValueError(f"offset is estimated with the preset auto; found {config.preset}")


@dataclass(frozen=True, eq=False)
class Offsets:
    """How long after its points an image is taken, per camera.

    Attributes:
        values_s: (n,) about which sums are taken, and to which points are moved.
        sigmas_s: (n,) standard deviations.
        adjoints: (n, 6, 6) from the twist of the LiDAR to that of each camera where it began: with
            those of newer estimates, frames of one twist would seem to show the offset.
    """

    values_s: Array
    sigmas_s: Array
    adjoints: Array

    @staticmethod
    def initial(rig: Rig) -> Offsets:
        """At the prior that a rig states."""
        cameras = rig.cameras.values()
        values = [clock_of(camera).offset_s for camera in cameras]
        sigmas = [prior_sigma_s(camera) for camera in cameras]
        return Offsets(np.array(values), np.array(sigmas), np.tile(np.eye(6), (len(values), 1, 1)))

    def with_camera(self, camera: int, value_s: float, sigma_s: float) -> Offsets:
        """With one of them replaced."""
        values_s, sigmas_s = self.values_s.copy(), self.sigmas_s.copy()
        values_s[camera], sigmas_s[camera] = value_s, sigma_s
        return replace(self, values_s=values_s, sigmas_s=sigmas_s)

    def with_axes(self, camera: int, T_lidar_camera: gtsam.Pose3) -> Offsets:
        """With a camera that begins at a pose."""
        adjoints = self.adjoints.copy()
        adjoints[camera] = adjoint_camera_lidar(T_lidar_camera)
        return replace(self, adjoints=adjoints)

    def put_into(self, rig: Rig) -> Rig:
        """The rig with these offsets."""
        pairs = zip(rig.cameras.items(), self.values_s.tolist(), strict=True)
        cameras = {n: c.model_copy(update={"time_offset_s": value}) for (n, c), value in pairs}
        return rig.model_copy(update={"cameras": cameras})

    def variable(self, rig: Rig, camera: int) -> LensVariable:
        """The variable of a camera, with its value here."""
        own = [*rig.cameras.values()][camera]
        variable = LensVariable.of(own, ("offset",))
        away_s = self.values_s[[camera]] - clock_of(own).offset_s
        return variable.moved_to(away_s / variable.free.sigmas[0])


def prior_sigma_s(camera: Camera) -> float:
    """The standard deviation of the prior of a camera's offset."""
    return LensVariable.of(camera, ("offset",)).free.sigmas[0]


def delayed(raw: CameraBlock, seconds: float) -> CameraBlock:
    """Matches of one frame with their points where they are some seconds later."""
    block = raw.block
    if block.motion is None or not seconds:
        return raw
    step = gtsam.Pose3.Expmap(-seconds * block.motion[0, :6]).matrix()
    points = block.points_lidar_m @ step[:3, :3].T + step[:3, 3]
    motion = block.motion + np.append(np.zeros(6), seconds)
    return replace(raw, block=replace(block, points_lidar_m=points, motion=motion))
