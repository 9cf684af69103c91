"""One camera's extrinsic from its correspondences in one frame: robust PnP."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_block import MIN_MATCHES
from calibgraph.solver.factor_graph import optimize, projection_graph
from factors import ProjectionBlock, smallest_scaled_eigenvalue

Array = NDArray[np.float64]

_REFINEMENTS = 2  # the first with the inliers of PnP, the second with those of the first
_MAX_SAMPLE = 4000  # matches; chosen, not measured
_RANSAC_ITERATIONS = 2000  # samples of 4: with 80 % outliers, one is clean in 19 of 20 runs
_MAX_ANGLE_RAD = np.radians(80.0)  # PnP works on a plane: wider rays would dominate it
_MIN_INLIER_SHARE = 0.1  # chosen, not measured
_MIN_SCALED_EIGENVALUE = 1e-9  # below it a direction is free: points on one line, or in one place


def frame_pose(camera: Camera, matches: Correspondences, config: Config) -> Array | None:
    """(4, 4) T_camera_lidar from one camera's matches in one frame.

    MAGSAC on the undistorted plane, then inliers re-selected and refined with the full lens model.
    Of many matches an even selection is used.

    Returns:
        None if too few matches agree on an extrinsic, or if they leave a direction of it free.
    """
    matches = matches.select(slice(None, None, -(-len(matches) // _MAX_SAMPLE) or None))
    start = _ransac_pnp(camera, matches, config)
    return None if start is None else _refine(camera, matches, start, config)


def normalized(camera: Camera, pixels_px: Array) -> Array:
    """(n, 2) pixels to the plane z = 1 of the camera frame, lens distortion removed."""
    if len(pixels_px) == 0:
        return np.empty((0, 2))
    pixels = np.ascontiguousarray(pixels_px[:, None, :])
    distortion = np.array(camera.distortion, dtype=np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    undistort: dict[str, Callable[..., Any]] = {
        "fisheye": cv2.fisheye.undistortPoints,
        "pinhole": cv2.undistortPoints,
    }
    plane = undistort[camera.model](pixels, camera.matrix_px, distortion, criteria=criteria)
    return np.asarray(plane, dtype=np.float64).reshape(-1, 2)


def _ransac_pnp(camera: Camera, frame: Correspondences, config: Config) -> Array | None:
    """(4, 4) T_camera_lidar of one frame by MAGSAC, None if there is no pose."""
    if len(frame) < MIN_MATCHES:
        return None
    plane = normalized(camera, frame.pixels_px)
    usable = np.hypot(plane[:, 0], plane[:, 1]) < np.tan(_MAX_ANGLE_RAD)
    if np.count_nonzero(usable) < MIN_MATCHES:
        return None
    parameters = cv2.UsacParams()
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.threshold = config.pnp_threshold_px
    parameters.maxIterations = _RANSAC_ITERATIONS
    parameters.confidence = 0.999
    parameters.randomGeneratorState = config.seed
    focal = camera.intrinsics_px.fx
    ideal = np.diag([focal, focal, 1.0])
    try:
        found, _, rotation, translation, _ = cv2.solvePnPRansac(
            frame.points_lidar_m[usable], plane[usable] * focal, ideal, None, params=parameters
        )
    except cv2.error:  # degenerate samples: all points in one place, or on one line
        return None
    if not found or not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        return None
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0]
    T[:3, 3] = translation.ravel()
    return T


def _refine(
    camera: Camera, frame: Correspondences, T_camera_lidar: Array, config: Config
) -> Array | None:
    """Re-select inliers with the full lens model and refine on them, a few times."""
    for _ in range(_REFINEMENTS):
        T_lidar_camera = to_T_lidar_camera(T_camera_lidar)
        every_match = ProjectionBlock(camera.lens, frame.points_lidar_m, frame.pixels_px)
        residuals, projectable = every_match.residuals(T_lidar_camera)
        inlier = projectable & (np.hypot(*residuals.T) < config.pnp_threshold_px)
        if np.count_nonzero(inlier) < max(MIN_MATCHES, _MIN_INLIER_SHARE * len(frame)):
            return None
        block = ProjectionBlock(
            camera.lens,
            frame.points_lidar_m[inlier],
            frame.pixels_px[inlier],
            scale=config.pnp_threshold_px / 2,
        )
        graph = projection_graph(["camera"], {"camera": block})
        optimum = optimize(graph, ["camera"], {"camera": T_camera_lidar})
        T_camera_lidar = optimum.T_camera_lidar["camera"]
        hessian = block.sums(to_T_lidar_camera(T_camera_lidar)).hessian
        if smallest_scaled_eigenvalue(hessian) < _MIN_SCALED_EIGENVALUE:
            return None
    return T_camera_lidar
