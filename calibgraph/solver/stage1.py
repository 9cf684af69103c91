"""Stage 1 of the paper: one extrinsic per camera and frame by PnP, then one per camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.clock import at_pixels
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import transform, twists_between
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import map_on_cores
from calibgraph.solver.frame_poses import COARSE, Runs, fit_frames
from calibgraph.solver.geodesic_median import geodesic_median
from calibgraph.solver.grid import frame_edges
from calibgraph.solver.pnp import (
    frame_pose,
    pose_near_guess,
    ransac_pnp,
    refine_frames,
    select_evenly,
)
from factors import ProjectionBlock, to_runs

_OUTLIER = 6.0  # median distances, 9 sigma of a Gaussian in three dimensions
COMMON_SAMPLE = 1000
"""Matches of all frames, for a pose that single frames start from."""

_ALIKE_RAD, _ALIKE_M = np.radians(0.05), 0.01  # frames that differ by less all count


@dataclass(frozen=True, eq=False)
class CameraStage1:
    """The pairwise estimates of one camera.

    Attributes:
        T_camera_lidar: (4, 4) T_hat of the paper; None if no frame was solved.
        by_frame: (4, 4) T_camera_lidar from PnP, by frame number.
        per_frame: (f, 4, 4) the same without outliers.
        failed_frames: frames of which PnP gave none, or an outlier.
    """

    T_camera_lidar: Array | None
    by_frame: Mapping[int, Array] = field(default_factory=lambda: MappingProxyType({}))
    per_frame: Array = field(default_factory=lambda: np.empty((0, 4, 4)))
    failed_frames: int = 0


Stage1 = Mapping[str, CameraStage1]
"""The pairwise estimates, by camera."""


def estimate_stage1(rig: Rig, table: Correspondences, config: Config) -> Stage1:
    """The pairwise estimates T_hat: by PnP, or the extrinsics of the rig as they are.

    Args:
        rig: lenses; its extrinsics are used with ``config.stage1 == "rig"`` alone.
        table: preprocessed correspondences, those of a camera sorted by frame.
        config: ``stage1``, ``pnp_threshold_px``, ``seed``.
    """
    if config.stage1 == "rig":
        named = [name for name in rig.cameras if name in table.cameras]
        return {name: CameraStage1(rig.cameras[name].T_camera_lidar) for name in named}
    cameras = [*rig.cameras.values()]
    rows = [at_pixels(camera, table.of_camera(name)) for name, camera in rig.cameras.items()]
    common = map_on_cores(partial(_from_common_pose, config=config), cameras, rows)
    left = [[*np.flatnonzero(~frames.found).tolist()] for frames in common]
    searched = map_on_cores(
        partial(frame_pose, config=config),
        [camera for camera, numbers in zip(cameras, left, strict=True) for _ in numbers],
        [f.rows_of(i) for f, numbers in zip(common, left, strict=True) for i in numbers],
    )
    poses = iter(searched)
    return {
        name: aggregate_frames(
            *frames.with_poses({i: next(poses) for i in numbers}).solved, len(frames.runs)
        )
        for name, frames, numbers in zip(rig.cameras, common, left, strict=True)
    }


def T_hat(pairwise_estimates: Stage1) -> dict[str, Array]:
    """The (4, 4) estimate of every camera that has one."""
    return {
        name: estimate.T_camera_lidar
        for name, estimate in pairwise_estimates.items()
        if estimate.T_camera_lidar is not None
    }


@dataclass(frozen=True, eq=False)
class FramePoses:
    """The frames of one camera.

    Attributes:
        rows: its correspondences.
        runs: (f, 2) those of each frame.
        T_camera_lidar: (f, 4, 4).
        found: (f,) which of these hold.
    """

    rows: Correspondences
    runs: Runs
    T_camera_lidar: Array
    found: NDArray[np.bool_]

    def rows_of(self, frame: int) -> Correspondences:
        """The correspondences of the frame of that place."""
        return self.rows.select(slice(*self.runs[frame]))

    @property
    def solved(self) -> tuple[Array, NDArray[np.int64]]:
        """(s, 4, 4) the poses that hold, and (s,) the numbers of their frames."""
        return self.T_camera_lidar[self.found], self.rows.frame[self.runs[self.found, 0]]

    def with_poses(self, poses: Mapping[int, Array | None]) -> FramePoses:
        """With the poses of some frames, by their place; None where there is none."""
        T_camera_lidar, found = self.T_camera_lidar.copy(), self.found.copy()
        for frame, T in poses.items():
            if T is not None:
                T_camera_lidar[frame], found[frame] = T, True
        return replace(self, T_camera_lidar=T_camera_lidar, found=found)


def _from_common_pose(camera: Camera, rows: Correspondences, config: Config) -> FramePoses:
    """The poses of all frames at once, from one for all of them together.

    Found are those that explain the majority of the frame's correspondences: no other pose can
    explain more. Three of them do not count, which any pose explains. So if all are found from a
    fit that starts at the guess, nothing is left for MAGSAC to find.
    """
    sample = select_evenly(rows, COMMON_SAMPLE)
    near = frames_from(pose_near_guess(camera, sample, config), camera, rows, config)
    if near.found.all():
        return near
    return frames_from(ransac_pnp(camera, sample, config), camera, rows, config)


def frames_from(
    start: Array | None, camera: Camera, rows: Correspondences, config: Config
) -> FramePoses:
    """The poses of frames from one (4, 4) T_camera_lidar near all of them; None: none is found."""
    runs = to_runs(frame_edges(rows.camera_index, rows.frame))
    none = np.zeros(len(runs), dtype=np.bool_)
    if start is None:
        return FramePoses(rows, runs, np.tile(np.eye(4), (len(runs), 1, 1)), none)
    block = ProjectionBlock(camera.lens, rows.points_lidar_m, rows.pixels_px)
    wide = block.rescale(scale=config.pnp_threshold_px / 2)
    near = fit_frames(wide, runs, np.tile(start, (len(runs), 1, 1)), tolerance=COARSE)
    refined = refine_frames(block, runs, near.T_camera_lidar, config)
    majority = refined.inliers - 3 > (runs[:, 1] - runs[:, 0]) / 2
    return FramePoses(rows, runs, refined.T_camera_lidar, refined.found & majority)


def aggregate_frames(poses: Array, numbers: NDArray[np.int64], frames: int) -> CameraStage1:
    """One extrinsic over the frames of a camera.

    Args:
        poses: (f, 4, 4) T_camera_lidar of the frames that have one.
        numbers: (f,) of these frames.
        frames: how many there are in all.
    """
    median = median_pose(poses) if len(poses) else None
    near = are_near_median(poses, median)
    kept, T_hat = poses[near], median
    if not near.all():
        T_hat = median_pose(kept) if len(kept) else None
    return CameraStage1(
        T_camera_lidar=T_hat,
        by_frame=MappingProxyType(dict(zip(numbers.tolist(), poses, strict=True))),
        per_frame=kept,
        failed_frames=frames - len(kept),
    )


def are_near_median(T_camera_lidar: Array, median: Array | None = None) -> NDArray[np.bool_]:
    """(f,) which of (f, 4, 4) per-frame estimates are no outliers among them.

    An outlier is more than 6 times the median distance from their median, in rotation or
    translation, and more than 0.05 degrees or 1 cm. Of fewer than 3, none is one.

    Args:
        T_camera_lidar: (f, 4, 4).
        median: (4, 4) of them, see :func:`median_pose`; None: computed.
    """
    if len(T_camera_lidar) < 3:  # noqa: PLR2004
        return np.ones(len(T_camera_lidar), dtype=np.bool_)
    median = median_pose(T_camera_lidar) if median is None else median
    angles = np.linalg.norm(twists_between(T_camera_lidar, median)[:, :3], axis=1)
    lengths = np.linalg.norm(T_camera_lidar[:, :3, 3] - median[:3, 3], axis=1)
    near = [
        distances <= max(least, _OUTLIER * float(np.median(distances)))
        for distances, least in ((angles, _ALIKE_RAD), (lengths, _ALIKE_M))
    ]
    return np.asarray(near[0] & near[1])


def median_pose(T_camera_lidar: Array) -> Array:
    """(4, 4) of (f, 4, 4): component-wise for the translation, geodesic L1 for the rotation."""
    rotations = Rotation.from_matrix(T_camera_lidar[:, :3, :3])
    return transform(geodesic_median(rotations), np.median(T_camera_lidar[:, :3, 3], axis=0))
