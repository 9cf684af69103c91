"""Robust poses of frames of one camera: many at once over stacked sums, and of one by MAGSAC."""

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera
from calibgraph.solver.matches import MIN_MATCHES
from factors import ProjectionBlock, unproject
from factors.conditioning import smallest_scaled_eigenvalues

Runs = NDArray[np.int64]
"""(f, 2): the first correspondence of each frame, and the one behind its last."""

DAMPING = 1e-6
"""Of the diagonal, for frames that leave a direction free."""
FINE, COARSE = 1e-6, 1e-3
"""Relative decrease of the cost at which a fit stops: at the optimum; as a start for another."""
_MIN_INLIER_SHARE = 0.1  # chosen, not measured
_MIN_SCALED_EIGENVALUE = 1e-9  # below it a direction is free: points on one line, or in one place


def refine_frames(
    block: ProjectionBlock,
    runs: Runs,
    T_camera_lidar: Array,
    config: Config,
    *,
    tolerances: Sequence[float] = (COARSE, FINE),
) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Re-select each frame's inliers with the full lens model and refine on them.

    Args:
        block: of all frames, with all their matches, unweighted.
        runs: (f, 2) those of each frame, one behind the other.
        T_camera_lidar: (f, 4, 4) starts.
        config: ``pnp_threshold_px``.
        tolerances: of each fit; by default one with the inliers of PnP, and one with those of it.

    Returns:
        (f, 4, 4) poses; (f,) whether enough matches agree on each, and leave no direction of it
        free; (f,) matches within the threshold.
    """
    least = np.maximum(MIN_MATCHES, _MIN_INLIER_SHARE * (runs[:, 1] - runs[:, 0]))
    found = np.ones(len(runs), dtype=np.bool_)
    for tolerance in tolerances:
        residuals, projectable = block.residuals(T_camera_lidar, runs)
        squared = residuals[:, 0] ** 2 + residuals[:, 1] ** 2
        inlier = projectable & (squared < config.pnp_threshold_px**2)
        places = np.concatenate([[0], np.cumsum(inlier)])[runs]
        inliers = places[:, 1] - places[:, 0]
        found &= inliers >= least
        some = block.select(inlier).rescale(scale=config.pnp_threshold_px / 2)
        places[~found] = 0
        T_camera_lidar, own, _ = some.fit(T_camera_lidar, places, tolerance=tolerance)
        found &= smallest_scaled_eigenvalues(own.hessian) >= _MIN_SCALED_EIGENVALUE
    return T_camera_lidar, found, inliers


_MAX_SAMPLE = 4000  # matches; chosen, not measured
RANSAC_ITERATIONS = 2000
"""Samples of 4 matches: with 80 % outliers, one is clean in 19 of 20 runs."""
_MAX_ANGLE_RAD = np.radians(80.0)  # PnP works on a plane: wider rays would dominate it
_CONE_RAD = np.radians(60.0)  # of a lens that sees all round: what one plane serves well
_DIRECTIONS = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
_WIDE = 10.0  # PnP thresholds: the scale of the loss of a fit from the guess


def magsac(threshold: float, *, iterations: int, seed: int) -> cv2.UsacParams:
    """Settings of OpenCV's RANSAC with the score of MAGSAC and a local optimization."""
    parameters = cv2.UsacParams()
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.threshold = threshold
    parameters.maxIterations = iterations
    parameters.confidence = 0.999
    parameters.randomGeneratorState = seed
    return parameters


def frame_pose(
    camera: Camera,
    matches: Correspondences | ProjectionBlock,
    config: Config,
    *,
    iterations: int = RANSAC_ITERATIONS,
) -> Array | None:
    """(4, 4) T_camera_lidar from one camera's matches in one frame.

    MAGSAC on the undistorted plane, then inliers re-selected and refined with the full lens model.
    Of many matches an even selection is used.

    Args:
        camera: its lens.
        matches: of one frame, taken without weights.
        config: ``pnp_threshold_px``, ``seed``.
        iterations: samples of MAGSAC, at most.

    Returns:
        None if too few matches agree on an extrinsic, or if they leave a direction of it free.
    """
    step = -(-len(matches) // _MAX_SAMPLE) or None
    points_lidar_m, pixels_px = matches.points_lidar_m[::step], matches.pixels_px[::step]
    block = ProjectionBlock(camera.lens, points_lidar_m, pixels_px)
    start = ransac_pnp(camera, block, config, iterations=iterations)
    if start is None:
        return None
    T, found, _ = refine_frames(block, np.array([[0, len(block)]]), start[None], config)
    return T[0] if found[0] else None


def ransac_pnp(
    camera: Camera,
    matches: Correspondences | ProjectionBlock,
    config: Config,
    *,
    iterations: int = RANSAC_ITERATIONS,
) -> Array | None:
    """(4, 4) T_camera_lidar by MAGSAC, None if there is no pose. Arguments as of `frame_pose`."""
    if len(matches) < MIN_MATCHES:
        return None
    turn, plane = view_plane(camera, matches.pixels_px)
    usable = np.isfinite(plane[:, 0])
    if np.count_nonzero(usable) < MIN_MATCHES:
        return None
    parameters = magsac(config.pnp_threshold_px, iterations=iterations, seed=config.seed)
    points, focal = matches.points_lidar_m[usable], camera.lens.pixels_per_rad
    found = ransac_on_plane(points, plane[usable], focal, parameters, turn=turn)
    return None if found is None else found[0]


def ransac_on_plane(
    points_m: Array, plane: Array, focal_px: float, parameters: cv2.UsacParams, *, turn: Array
) -> tuple[Array, int] | None:
    """(4, 4) pose of a camera from points and where it sees them, and how many points agree.

    Args:
        points_m: (n, 3).
        plane: (n, 2) where, on the plane z = 1 of the turned camera frame.
        focal_px: in whose pixels the threshold of the parameters is.
        parameters: of RANSAC.
        turn: (3, 3) from the camera frame to the turned one.

    Returns:
        None where the points determine no pose.
    """
    ideal = np.diag([focal_px, focal_px, 1.0])
    try:
        found, _, rotation, translation, inliers = cv2.solvePnPRansac(
            points_m, focal_px * plane, ideal, None, params=parameters
        )
    except cv2.error:  # degenerate samples: all points in one place, or on one line
        return None
    if not found or not np.isfinite(rotation).all() or not np.isfinite(translation).all():
        return None
    T = transform(cv2.Rodrigues(rotation)[0], translation.ravel())
    T[:3] = turn.T @ T[:3]
    return T, 0 if inliers is None else len(inliers)


def pose_near_guess(
    camera: Camera, matches: Correspondences | ProjectionBlock, config: Config
) -> Array | None:
    """(4, 4) T_camera_lidar by a robust fit from the camera's own, None of too few matches.

    Its loss is wide, to be found from farther than the PnP threshold. Arguments as of `frame_pose`.
    """
    if len(matches) < MIN_MATCHES:
        return None
    block = ProjectionBlock(camera.lens, matches.points_lidar_m, matches.pixels_px)
    wide = block.rescale(scale=_WIDE * config.pnp_threshold_px)
    start, runs = camera.T_camera_lidar[None], np.array([[0, len(block)]])
    T_camera_lidar, *_ = wide.fit(start, runs, tolerance=COARSE)
    return np.asarray(T_camera_lidar[0])


def view_plane(camera: Camera, pixels_px: Array) -> tuple[Array, Array]:
    """A turn of the camera, and its pixels on the plane z = 1 of the turned frame.

    The turn (3, 3) is the identity for lenses that look ahead. Of those that see all round, it is
    to the direction with most of the pixels about it. Pixels (n, 2) too far from there, and those
    that the lens has no ray for, are NaN.
    """
    rays, valid = unproject(camera.lens, pixels_px)
    turn, most_rad = np.eye(3), _MAX_ANGLE_RAD
    if camera.model not in ("pinhole", "fisheye"):
        cosines, ahead, most_rad = _DIRECTIONS @ rays[valid].T, [[0.0, 0.0, 1.0]], _CONE_RAD
        about = (cosines > np.cos(_CONE_RAD)).sum(axis=1)
        turn = Rotation.align_vectors(ahead, _DIRECTIONS[[about.argmax()]])[0].as_matrix()
    turned = rays @ turn.T
    usable = valid & (turned[:, 2] > np.cos(most_rad))
    with np.errstate(divide="ignore", invalid="ignore"):
        return turn, np.where(usable[:, None], turned[:, :2] / turned[:, 2:], np.nan)
