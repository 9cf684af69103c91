"""The frames whose matches are kept: of the live epochs, and those that disagree."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, merge
from calibgraph.solver.columns import DistortionEvidence, distortion_evidence
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.gated import Gated
from calibgraph.tracking.sums import Sums

NO_DISTORTION = DistortionEvidence.none(WEAK, places=1)
"""Without matches."""


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """One frame whose matches are still kept.

    Attributes:
        number: of the frame.
        raw: per camera (by its place in the rig) whose matches were absorbed: all of them.
        inliers: per camera, (m,) which of them are within the gate.
        sums: (n,) of them, per camera.
        place: name of the place that it is of; empty: not known.
    """

    number: int
    raw: dict[int, CameraBlock]
    inliers: dict[int, NDArray[np.bool_]]
    sums: Sums
    place: str = ""

    def without(self, camera: int) -> LiveFrame:
        """The frame without one camera's matches."""
        raw = {c: m for c, m in self.raw.items() if c != camera}
        inliers = {c: rows for c, rows in self.inliers.items() if c != camera}
        sums = self.sums.replace_at(camera, Sums.zeros())
        return changed(self, raw=raw, inliers=inliers, sums=sums)

    def add(self, camera: int, gated: Gated, *, row: int = 0) -> LiveFrame:
        """The frame with a camera's matches: those of a row of the gated frames."""
        raw, inliers = gated.of_frame(row)
        return changed(
            self,
            raw={**self.raw, camera: raw},
            inliers={**self.inliers, camera: inliers},
            sums=self.sums.replace_at(camera, gated.sums[row]),
        )

    @staticmethod
    def empty(number: int, cameras: int, place: str = "") -> LiveFrame:
        """A frame without matches."""
        return LiveFrame(number, {}, {}, Sums.zeros(cameras), place)


@dataclass(frozen=True, eq=False)
class Epoch:
    """Frames that share one extrinsic per camera.

    Attributes:
        frames: in order.
        T_lidar_camera: per camera, the estimate.
        distortion: per camera, of its matches in the scan distortion, as if of one place; in an
            open epoch, of the frames from which it has started there.
    """

    frames: tuple[LiveFrame, ...]
    T_lidar_camera: tuple[gtsam.Pose3, ...]
    distortion: tuple[DistortionEvidence, ...]

    @staticmethod
    def empty(T_lidar_camera: tuple[gtsam.Pose3, ...]) -> Epoch:
        """Without frames."""
        return Epoch((), T_lidar_camera, (NO_DISTORTION,) * len(T_lidar_camera))

    @cached_property
    def sums(self) -> Sums:
        """(n,) over its frames, per camera."""
        return self.sums_of(self.frames)

    def sums_of(self, frames: Iterable[LiveFrame]) -> Sums:
        """(n,) over some of its frames, per camera."""
        none = Sums.zeros(len(self.T_lidar_camera))
        return Sums.stack([none, *(frame.sums for frame in frames)]).total()

    def with_distortion(self, camera: int, scale: ResidualScale) -> Epoch:
        """The epoch with a camera's evidence of the scan distortion computed anew.

        At each place the camera has a pose of its own. What no such pose can follow is left in the
        residuals, at whatever estimate: so it holds on when a camera moves or drifts.
        """
        own, found = inliers_of(self.frames, camera), NO_DISTORTION
        if own is not None and len(own) >= MIN_MATCHES:
            numbers: dict[str, list[int]] = {}
            for frame in self.frames:
                numbers.setdefault(frame.place, []).append(frame.number)
            places = [np.array(of_place, dtype=np.int64) for of_place in numbers.values()]
            pose = self.T_lidar_camera[camera]
            found = distortion_evidence(own, scale, pose, WEAK, places=places).as_of_one_place()
        before, after = self.distortion[:camera], self.distortion[camera + 1 :]
        return changed(self, distortion=(*before, found, *after))


@dataclass(frozen=True, eq=False)
class OutlierFrame:
    """A frame that disagrees with a camera's estimate but fits another T_lidar_camera.

    Attributes:
        number: of the frame.
        raw: its matches.
        T_lidar_camera: that fits them.
    """

    number: int
    raw: CameraBlock
    T_lidar_camera: gtsam.Pose3


def inliers_of(frames: Iterable[LiveFrame], camera: int) -> CameraBlock | None:
    """A camera's matches within the gate, of frames; None if there are none."""
    own = [frame for frame in frames if camera in frame.raw]
    if not own:
        return None
    rows = np.concatenate([frame.inliers[camera] for frame in own])
    return merge([frame.raw[camera] for frame in own]).select(rows)
