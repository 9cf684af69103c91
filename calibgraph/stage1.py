"""Stage 1: one pose per camera and frame by PnP, then one per camera over the frames."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.config import Config
from calibgraph.correspondences import Correspondences
from calibgraph.graph import optimize, projection_graph, to_T_lidar_camera
from calibgraph.matches import MIN_MATCHES
from calibgraph.rig import Camera, Rig
from factors import ProjectionBlock

Array = NDArray[np.float64]

_REFINEMENTS = 2
_ENOUGH_MATCHES = 4000
_RANSAC_ITERATIONS = 2000
_MAX_ANGLE_RAD = np.radians(80.0)  # PnP works on a plane: wider rays would dominate it
_MIN_INLIER_SHARE = 0.1
_MEDOID_OF = 500  # rotations at most: it is a start, and its cost is quadratic
_STRAY = 6.0  # median distances from the median: farther frames do not count
_STRAY_RAD, _STRAY_M = np.radians(0.05), 0.01  # nearer ones always do
_MIN_SCALED_EIGENVALUE = 1e-9  # of the unit-diagonal Hessian: rounding noise is near 1e-15


@dataclass(frozen=True)
class Stage1:
    """The pairwise estimates.

    Attributes:
        T_camera_lidar: per camera with at least one solved frame, (4, 4): T_hat of the paper.
        solved: per camera, (4, 4) the poses that PnP gave, by the frames' numbers.
        per_frame: per camera, (f, 4, 4) those that are not far from all others.
        failed_frames: per camera, how many frames gave no pose, or one far from all others.
    """

    T_camera_lidar: dict[str, Array]
    solved: dict[str, dict[int, Array]]
    per_frame: dict[str, Array]
    failed_frames: dict[str, int]


def estimate_stage1(rig: Rig, table: Correspondences, config: Config) -> Stage1:
    """Solve every camera and frame by PnP, then aggregate over frames (paper, section 3.3).

    Args:
        rig: lenses; its poses are not used.
        table: preprocessed correspondences, those of a camera sorted by frame.
        config: ``aggregate``, ``pnp_threshold_px``, ``seed``.
    """
    stage1 = Stage1({}, {}, {}, {})
    with ThreadPoolExecutor() as pool:
        for name, camera in rig.cameras.items():
            rows = table.of_camera(name)
            numbers, starts = np.unique(rows.frame, return_index=True)
            edges = np.append(starts, len(rows))
            frames = [rows.select(slice(*edge)) for edge in pairwise(edges)]
            poses = pool.map(lambda f, c=camera: frame_pose(c, f, config), frames)
            found = {
                int(n): pose for n, pose in zip(numbers, poses, strict=True) if pose is not None
            }
            solved = np.array([*found.values()]).reshape(-1, 4, 4)
            stage1.solved[name] = found
            stage1.per_frame[name] = solved[agreeing(solved)]
            stage1.failed_frames[name] = len(frames) - len(stage1.per_frame[name])
            if len(solved):
                estimate = aggregate(stage1.per_frame[name], config.aggregate)
                stage1.T_camera_lidar[name] = estimate
    return stage1


def frame_pose(camera: Camera, matches: Correspondences, config: Config) -> Array | None:
    """(4, 4) T_camera_lidar from one camera's matches in one frame, None if they give none.

    MAGSAC on the undistorted plane, then inliers re-selected and refined with the full lens model.
    No pose, if too few matches agree on one, or if they leave a direction free. Of many matches
    an even selection is used: it is enough for one frame's pose.
    """
    matches = matches.select(slice(None, None, -(-len(matches) // _ENOUGH_MATCHES) or None))
    start = _ransac_pnp(camera, matches, config)
    return None if start is None else _refine(camera, matches, start, config)


def agreeing(poses: Array) -> NDArray[np.bool_]:
    """Which of (f, 4, 4) poses are not far from all others, judged by the poses alone.

    Far is more than 6 times the median distance from their median, in rotation or translation;
    up to 0.05 degrees and 1 cm never are. Fewer than 3 poses cannot be judged.
    """
    if len(poses) < 3:  # noqa: PLR2004
        return np.ones(len(poses), dtype=np.bool_)
    rotations, translations = Rotation.from_matrix(poses[:, :3, :3]), poses[:, :3, 3]
    angles = (rotations * geodesic_median(rotations).inv()).magnitude()
    lengths = np.linalg.norm(translations - np.median(translations, axis=0), axis=1)
    near = [
        distances <= max(least, _STRAY * float(np.median(distances)))
        for distances, least in ((angles, _STRAY_RAD), (lengths, _STRAY_M))
    ]
    return np.asarray(near[0] & near[1])


def normalized(camera: Camera, pixels_px: Array) -> Array:
    """(n, 2) pixels to the plane z = 1 of the camera frame, lens distortion removed."""
    if len(pixels_px) == 0:
        return np.empty((0, 2))
    pixels = np.ascontiguousarray(pixels_px[:, None, :])
    distortion = np.array(camera.distortion, dtype=np.float64)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    if camera.model == "fisheye":
        plane = cv2.fisheye.undistortPoints(pixels, camera.matrix_px, distortion, criteria=criteria)
    else:
        plane = cv2.undistortPoints(pixels, camera.matrix_px, distortion, criteria=criteria)
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
        everything = ProjectionBlock(camera.lens, frame.points_lidar_m, frame.pixels_px)
        residuals, valid = everything.residuals(T_lidar_camera)
        inlier = valid & (np.hypot(*residuals.T) < config.pnp_threshold_px)
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
        if _is_degenerate(block.sums(to_T_lidar_camera(T_camera_lidar)).hessian):
            return None
    return T_camera_lidar


def _is_degenerate(hessian: Array) -> bool:
    """Whether some direction of the pose is free: points on one line, or in one place."""
    units = np.sqrt(np.diag(hessian))
    if not units.all():
        return True
    return bool(np.linalg.eigvalsh(hessian / np.outer(units, units))[0] < _MIN_SCALED_EIGENVALUE)


def aggregate(poses: Array, how: str) -> Array:
    """One pose from several.

    Args:
        poses: (f, 4, 4), f >= 1.
        how: ``median``: component-wise for the translation, geodesic L1 for the rotation;
            ``mean``: arithmetic and chordal; ``mode``: half-sample mode of each component, the
            rotation's in the tangent at its median.
    """
    T = np.eye(4)
    rotations, translations = Rotation.from_matrix(poses[:, :3, :3]), poses[:, :3, 3]
    median = geodesic_median(rotations)
    if how == "median":
        rotation, T[:3, 3] = median, np.median(translations, axis=0)
    elif how == "mean":
        rotation, T[:3, 3] = rotations.mean(), translations.mean(axis=0)
    elif how == "mode":
        tangents = (rotations * median.inv()).as_rotvec()
        mode = np.array([half_sample_mode(column) for column in tangents.T])
        rotation = Rotation.from_rotvec(mode) * median
        T[:3, 3] = [half_sample_mode(column) for column in translations.T]
    else:
        raise ValueError(f"unknown aggregate {how!r}; known are median, mean, mode")
    T[:3, :3] = rotation.as_matrix()
    return T


def geodesic_median(rotations: Rotation) -> Rotation:
    """Rotation with the least sum of angles to the given ones (Weiszfeld on SO(3))."""
    medoid = rotations[_medoid(rotations)]
    median: Rotation = medoid
    for _ in range(100):
        tangents = (rotations * median.inv()).as_rotvec()
        weights = 1.0 / np.maximum(np.linalg.norm(tangents, axis=1), 1e-12)
        step = weights @ tangents / weights.sum()
        median = Rotation.from_rotvec(step) * median
        if np.linalg.norm(step) < 1e-12:  # noqa: PLR2004 - far below any rotation that matters
            break
    return median


def _medoid(rotations: Rotation) -> int:
    """Which of the rotations has the least sum of angles to the others; of many, to some."""
    quaternions = rotations.as_quat()
    places = np.unique(np.linspace(0, len(quaternions) - 1, _MEDOID_OF).round().astype(int))
    some = quaternions[places]
    cosines = np.abs(some @ some.T).clip(max=1.0)
    return int(places[np.argmin(np.arccos(cosines).sum(axis=0))])


def half_sample_mode(samples: Sequence[float] | Array) -> float:
    """Mode of a sample: keep the densest half, again and again (Bickel and Fruehwirth 2006)."""
    x = np.sort(np.asarray(samples, dtype=np.float64))
    while len(x) > 2:  # noqa: PLR2004 - two values have no denser half
        half = (len(x) + 1) // 2
        widths = x[half - 1 :] - x[: len(x) - half + 1]
        start = int(np.argmin(widths))
        x = x[start : start + half]
    return float(x.mean())
