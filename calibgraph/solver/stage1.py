"""Stage 1 of the paper: one extrinsic per camera and frame by PnP, then one per camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.model.geometry import retract_all, twists_between
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import map_on_cores
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.pnp import (
    COARSE,
    FINE,
    Runs,
    frame_pose,
    pose_near_guess,
    ransac_pnp,
    refine_frames,
)
from factors import ProjectionBlock, to_runs
from factors.pose_kernel import logarithms

_OUTLIER = 6.0  # median distances, 9 sigma of a Gaussian in three dimensions
COMMON_SAMPLE = 1000
"""Matches of all frames, for a pose that single frames start from."""

_MEDOID_OF = 500  # rotations at most: it is a start of the median, and its cost is quadratic
_STEPS, _LEAST_RAD = 50, 1e-5  # of the median: far below any rotation that matters
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


def estimate_stage1(rig: Rig, blocks: Mapping[str, CameraBlock], config: Config) -> Stage1:
    """The pairwise estimates T_hat: by PnP, or the extrinsics of the rig as they are.

    Args:
        rig: lenses; its extrinsics are used with ``config.stage1 == "rig"`` alone.
        blocks: per camera, its correspondences; their weights are not used.
        config: ``stage1``, ``pnp_threshold_px``, ``seed``.
    """
    cameras = [rig.cameras[name] for name in blocks]
    if config.stage1 == "rig":
        each = [CameraStage1(camera.T_camera_lidar) for camera in cameras]
        return dict(zip(blocks, each, strict=True))
    plain = [block.block.rewhiten(None) for block in blocks.values()]
    runs = [to_runs(block.frame_edges) for block in blocks.values()]
    common = map_on_cores(partial(_from_common_pose, config=config), cameras, plain, runs)
    left = [
        (number, frame)
        for number, (_, found) in enumerate(common)
        for frame in np.flatnonzero(~found).tolist()
    ]
    searched = map_on_cores(
        partial(frame_pose, config=config),
        [cameras[number] for number, _ in left],
        [plain[number].select(np.arange(*runs[number][frame])) for number, frame in left],
    )
    for (number, frame), T in zip(left, searched, strict=True):
        if T is not None:
            poses, found = common[number]
            poses[frame], found[frame] = T, True
    return {
        name: aggregate_frames(poses[found], block.frame_numbers[found], block.frames)
        for (name, block), (poses, found) in zip(blocks.items(), common, strict=True)
    }


def T_hat(pairwise_estimates: Stage1) -> dict[str, Array]:
    """The (4, 4) estimate of every camera that has one."""
    return {
        name: estimate.T_camera_lidar
        for name, estimate in pairwise_estimates.items()
        if estimate.T_camera_lidar is not None
    }


def _from_common_pose(
    camera: Camera, block: ProjectionBlock, runs: Runs, config: Config
) -> tuple[Array, NDArray[np.bool_]]:
    """(f, 4, 4) poses of all frames from one for all of them together, and (f,) which are found.

    Found are those that explain the majority of the frame's correspondences: no other pose can
    explain more. Three of them do not count, which any pose explains. So if all are found from a
    fit that starts at the guess, nothing is left for MAGSAC to find.
    """
    sample = block.select(np.arange(0, len(block), -(-len(block) // COMMON_SAMPLE)))
    poses, found = np.tile(np.eye(4), (len(runs), 1, 1)), np.zeros(len(runs), dtype=np.bool_)
    wide = block.rescale(scale=config.pnp_threshold_px / 2)
    for start_of in (pose_near_guess, ransac_pnp):
        if found.all() or (start := start_of(camera, sample, config)) is None:
            break
        near, *_ = wide.fit(start[None], runs, tolerance=COARSE)
        poses, found, inliers = refine_frames(block, runs, near, config, tolerances=[FINE])
        found &= inliers - 3 > (runs[:, 1] - runs[:, 0]) / 2
    return poses, found


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
    """(4, 4) of (f, 4, 4): component-wise for the translation, geodesic L1 for the rotation.

    That is the rotation with the least sum of angles to the others, by Weiszfeld's algorithm.
    """
    T, rotations = np.eye(4), T_camera_lidar[:, :3, :3]
    some = rotations[:: -(-len(rotations) // _MEDOID_OF)]
    cosines = np.einsum("aij,bij->ab", some, some) / 2 - 0.5
    T[:3, :3] = some[np.argmin(np.arccos(cosines.clip(-1.0, 1.0)).sum(axis=0))]
    turned = np.tile(np.eye(4), (len(rotations), 1, 1))
    for _ in range(_STEPS):
        turned[:, :3, :3] = rotations @ T[:3, :3].T
        twists = logarithms(turned)
        weights = 1.0 / np.maximum(np.linalg.norm(twists, axis=1), _LEAST_RAD)
        step = weights @ twists / weights.sum()
        T = retract_all(T[None], -step[None])[0]
        if np.linalg.norm(step) < _LEAST_RAD:
            break
    T[:3, 3] = np.median(T_camera_lidar[:, :3, 3], axis=0)
    return T
