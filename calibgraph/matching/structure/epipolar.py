"""Epipolar geometry: the relative pose of two cameras from features that both see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera
from calibgraph.solver.pnp import normalized

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

MAX_SIDE_PX = 1300  # larger images are reduced: bounds the time
MAX_FEATURES = 3000  # per image
LOWE_RATIO = 0.8  # of the distances of the best and the second best match, at most
MAX_ANGLE_RAD = np.radians(80.0)  # off the axis
THRESHOLD_PX = 1.0
MIN_INLIERS = 40  # over all frames; fewer come together by chance


@dataclass(frozen=True, eq=False)
class Features:
    """SIFT features of an image.

    Attributes:
        pixels_px: (n, 2).
        descriptors: (n, 128).
    """

    pixels_px: Array
    descriptors: NDArray[np.float32]


def relative_pose_up_to_scale(
    a: Camera, b: Camera, images_a: Sequence[Features], images_b: Sequence[Features], *, seed: int
) -> Array | None:
    """Estimate the relative pose of two cameras, but for the length of its translation.

    Images do not determine this length. Where both cameras are nearly at the same place, they do
    not determine the translation's direction either. The cameras' extrinsics are not used.

    Args:
        a: lens of the one camera.
        b: lens of the other.
        images_a: features of the one's images.
        images_b: of the other's, in the same frames.
        seed: of the choice of samples.

    Returns:
        (4, 4) T_b_a with a translation of length one, or None if the views do not overlap.
    """
    rays_a, rays_b = _match_rays((a, b), images_a, images_b)
    if len(rays_a) < MIN_INLIERS:
        return None
    focal = min(a.intrinsics_px.fx, b.intrinsics_px.fx)
    ideal = np.diag([focal, focal, 1.0])
    pixels_a, pixels_b = focal * rays_a, focal * rays_b
    E, inliers = cv2.findEssentialMat(
        pixels_a, pixels_b, ideal, ideal, None, None, _magsac_parameters(seed)
    )
    if E is None or E.shape != (3, 3) or np.count_nonzero(inliers) < MIN_INLIERS:
        return None
    count, R, t, _ = cv2.recoverPose(E, pixels_a, pixels_b, ideal, mask=inliers)
    if count < MIN_INLIERS:
        return None
    T_b_a = np.eye(4)
    T_b_a[:3, :3], T_b_a[:3, 3] = R, t.ravel()
    return T_b_a


def _match_rays(
    cameras: tuple[Camera, Camera], images_a: Sequence[Features], images_b: Sequence[Features]
) -> tuple[Array, Array]:
    """Features that both cameras see, as points (n, 2) of their planes at distance one."""
    pairs = [_match_features(*images) for images in zip(images_a, images_b, strict=True)]
    rays = [
        normalized(camera, np.concatenate([pair[side] for pair in pairs]))
        for side, camera in enumerate(cameras)
    ]
    usable = np.all([np.hypot(*each.T) < np.tan(MAX_ANGLE_RAD) for each in rays], axis=0)
    return rays[0][usable], rays[1][usable]


def _magsac_parameters(seed: int) -> cv2.UsacParams:
    parameters = cv2.UsacParams()
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.threshold = THRESHOLD_PX
    parameters.maxIterations = 5000
    parameters.confidence = 0.999
    parameters.randomGeneratorState = seed
    return parameters


def _match_features(a: Features, b: Features) -> tuple[Array, Array]:
    """Pixels (n, 2) of the same features in two images."""
    if min(len(a.pixels_px), len(b.pixels_px)) < 2:  # noqa: PLR2004
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher().knnMatch(a.descriptors, b.descriptors, k=2)
    close = [(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < LOWE_RATIO * n.distance]
    rows = np.array(close).reshape(-1, 2).astype(np.intp)
    return a.pixels_px[rows[:, 0]], b.pixels_px[rows[:, 1]]


def detect_features(gray: Gray) -> Features:
    """The features of an image (height, width)."""
    factor = min(1.0, MAX_SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    points, found = cv2.SIFT.create(nfeatures=MAX_FEATURES).detectAndCompute(small, None)
    if not points:
        return Features(np.empty((0, 2)), np.empty((0, 128), np.float32))
    scale = np.array([gray.shape[1] / small.shape[1], gray.shape[0] / small.shape[0]])
    pixels_px = (np.array([p.pt for p in points]) + 0.5) * scale - 0.5
    return Features(pixels_px, np.asarray(found, dtype=np.float32))
