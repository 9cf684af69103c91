"""The time offset of each camera, where it is estimated while driving.

It is the variable of ``calibgraph.graph.lens`` with the part ``offset`` alone, and a random walk:
a closed epoch shows the offset as it was then. Matches that are kept have their points where they
were at the present offset, so that all else sees an image and a cloud of one time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.graph.lens import LensVariable
from calibgraph.model.clock import clock_of, require_motion, unused_times
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
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
        earlier: (n, 3) what the frames before the last move of each camera show: value [s],
            variance [s^2], and the number of updates then. A move of a mount leaves the clock.
        times: of the places that are kept apart, see ``calibgraph.tracking.offset_walk``.
    """

    values_s: Array
    sigmas_s: Array
    adjoints: Array
    earlier: Array
    times: Mapping[str, int] = field(default_factory=dict)

    @staticmethod
    def initial(rig: Rig) -> Offsets:
        """At the prior that a rig states."""
        cameras = rig.cameras.values()
        values = [clock_of(camera).offset_s for camera in cameras]
        sigmas = [prior_sigma_s(camera) for camera in cameras]
        n, nothing = len(values), [0.0, np.inf, 0.0]
        adjoints, earlier = np.tile(np.eye(6), (n, 1, 1)), np.tile(nothing, (n, 1))
        return Offsets(np.array(values), np.array(sigmas), adjoints, earlier)

    def with_camera(self, camera: int, value_s: float, sigma_s: float) -> Offsets:
        """With one of them replaced."""
        values_s, sigmas_s = self.values_s.copy(), self.sigmas_s.copy()
        values_s[camera], sigmas_s[camera] = value_s, sigma_s
        return replace(self, values_s=values_s, sigmas_s=sigmas_s)

    def with_earlier(self, camera: int, value_s: float, variance: float, at: int) -> Offsets:
        """With what frames before a move of a camera show, and the number of updates then."""
        earlier = self.earlier.copy()
        earlier[camera] = value_s, variance, at
        return replace(self, earlier=earlier)

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


def with_motion_in_use(
    rig: Rig, config: Config, table: Correspondences, before: bool | None
) -> Correspondences:
    """The matches of a frame, with the motion of the LiDAR where a clock uses it.

    Args:
        rig: with the clocks of its cameras.
        config: settings.
        table: the matches.
        before: whether that of earlier frames is known; None if there are none.

    Raises:
        CorrespondenceError: if the motion is needed and not known, or not known of all frames.
    """
    known = table.twist_per_s is not None
    require_motion(config.estimate, is_known=known)
    used = config.estimate or any(c.time_offset_s or c.readout_s for c in rig.cameras.values())
    if not used:
        return replace(table, twist_per_s=None) if known else table
    if before is not None and before != known:
        found, earlier = ("no ", "one") if not known else ("a ", "none")
        raise CorrespondenceError(
            f"it has {found}motion of the LiDAR (twist_per_s), earlier frames have {earlier}; the "
            "rig's time_offset_s and readout_s need it with every frame: give it or leave it out"
        )
    if before is None:
        unused_times(rig, is_known=known)
    return table


def motion_in(raw: CameraBlock, seconds: float) -> gtsam.Pose3:
    """Of the points of one frame as the LiDAR sees them; none if that of the LiDAR is unknown."""
    motion = raw.block.motion
    return gtsam.Pose3() if motion is None else gtsam.Pose3.Expmap(-seconds * motion[0, :6])


def delayed(raw: CameraBlock, seconds: float) -> CameraBlock:
    """Matches of one frame with their points where they are some seconds later."""
    block = raw.block
    if block.motion is None or not seconds:
        return raw
    step = motion_in(raw, seconds).matrix()
    points = block.points_lidar_m @ step[:3, :3].T + step[:3, 3]
    motion = block.motion + np.append(np.zeros(6), seconds)
    return replace(raw, block=replace(block, points_lidar_m=points, motion=motion))
