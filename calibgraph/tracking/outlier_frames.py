"""Frames that disagree with a camera's estimate: failed matches, or a camera that has moved."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.objective import projection_graph
from calibgraph.model.config import Config
from calibgraph.model.geometry import to_T_camera_lidar, to_T_lidar_camera
from calibgraph.model.rig import Camera
from calibgraph.solver.matches import MIN_MATCHES, CameraBlock
from calibgraph.solver.pnp import frame_pose
from calibgraph.solver.robust import ResidualScale
from calibgraph.solver.two_pass import optimize
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.live_frames import OutlierFrame

AGREEMENT = 0.7
"""A frame agrees with an estimate that explains this share of the usual share of its matches."""


def inlier_share(block: CameraBlock, T_lidar_camera: gtsam.Pose3, scale: ResidualScale) -> float:
    """Share of the matches within the gate at a T_lidar_camera."""
    errors, valid = block.errors_px(to_T_camera_lidar(T_lidar_camera))
    return float(np.mean(valid & (errors <= scale.gate_px)))


def agrees(block: CameraBlock, T_lidar_camera: gtsam.Pose3, camera_state: CameraState) -> bool:
    """Whether a T_lidar_camera explains about the usual share of a frame's matches."""
    return bool(agreeing_frames(block, T_lidar_camera, camera_state).all())


def agreeing_frames(
    block: CameraBlock, T_lidar_camera: gtsam.Pose3, camera_state: CameraState
) -> NDArray[np.bool_]:
    """(f,) whether it does of each frame of a block."""
    inside = block.within_gate(to_T_camera_lidar(T_lidar_camera), camera_state.scale.gate_px)
    counts = np.add.reduceat(inside, block.frame_edges[:-1], dtype=np.int64)
    least = AGREEMENT * camera_state.inlier_share * block.frame_counts
    return np.asarray((counts >= MIN_MATCHES) & (counts >= least))


def find_outlier_frame(
    number: int,
    block: CameraBlock,
    T_lidar_camera: gtsam.Pose3,
    *,
    camera: Camera,
    camera_state: CameraState,
    config: Config,
) -> OutlierFrame | None:
    """The frame with its own T_lidar_camera; None if none explains it, so the matching failed."""
    for start in _starts(block, T_lidar_camera, camera, config):
        T_own = refine(block, start, camera_state.scale, config)
        if agrees(block, T_own, camera_state):
            return OutlierFrame(number, block, T_own)
    return None


def _starts(
    block: CameraBlock, T_lidar_camera: gtsam.Pose3, camera: Camera, config: Config
) -> Iterator[gtsam.Pose3]:
    """Start values for the frame's own T_lidar_camera: the estimate; then PnP, if possible.

    PnP takes several times as long as a fit from the estimate, which is mostly near enough. Both
    end at the same minimum where most of the usual share of matches agrees.
    """
    yield T_lidar_camera
    if block.information is not None or config.stage1 == "rig":
        return
    by_pnp = frame_pose(camera, block.block, config)
    if by_pnp is not None:
        yield to_T_lidar_camera(by_pnp)


def refine(
    block: CameraBlock, start: gtsam.Pose3, scale: ResidualScale, config: Config
) -> gtsam.Pose3:
    """The T_lidar_camera that fits a camera's matches, with a wide loss first."""
    T = to_T_camera_lidar(start)
    widening = max(config.pnp_threshold_px / scale.gate_px, 1.0)
    for factor in (widening, 1.0):
        wide = ResidualScale(
            scale.sigma, scale.loss_scale * factor, scale.gate_px * factor, scale.sigma_px
        )
        inliers = block.without_outliers(T, wide)
        if len(inliers.frame) < MIN_MATCHES:
            return start
        graph = projection_graph(["camera"], {"camera": inliers.with_scale(wide)})
        T = optimize(graph, ["camera"], {"camera": T}).T_camera_lidar["camera"]
    return to_T_lidar_camera(T)
