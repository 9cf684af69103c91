"""How two cameras stand to each other, by what both see in the same frames (epipolar geometry)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera
from calibgraph.solver.pnp import normalized

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

MAX_SIDE_PX = 1300  # larger images are reduced: bounds the time
MAX_FEATURES = 3000  # per image
RATIO = 0.8  # of the distances of the best and the second best match, at most (Lowe)
MAX_ANGLE_RAD = np.radians(80.0)  # off the axis
THRESHOLD_PX = 1.0
MIN_INLIERS = 40  # over all frames; fewer come together by chance


def overlap_pose(
    a: Camera, b: Camera, grays_a: Sequence[Gray], grays_b: Sequence[Gray], *, seed: int
) -> Array | None:
    """T_b_a (4, 4) of two cameras, its translation of length one, or None if they share no view.

    The length of the translation cannot be seen in images, and where both cameras are at nearly the
    same place its direction means nothing either. The cameras' poses are not used.

    Args:
        a: lens of the one camera.
        b: lens of the other.
        grays_a: (height, width) images of the one.
        grays_b: of the other, in the same frames.
        seed: of the choice of samples.
    """
    matched = [_matched(*grays) for grays in zip(grays_a, grays_b, strict=True)]
    planes = [normalized(a, np.concatenate([m[0] for m in matched]))]
    planes.append(normalized(b, np.concatenate([m[1] for m in matched])))
    usable = np.all([np.hypot(*p.T) < np.tan(MAX_ANGLE_RAD) for p in planes], axis=0)
    on_a, on_b = (plane[usable] for plane in planes)
    if len(on_a) < MIN_INLIERS:
        return None
    parameters = cv2.UsacParams()
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.threshold = THRESHOLD_PX
    parameters.maxIterations = 5000
    parameters.confidence = 0.999
    parameters.randomGeneratorState = seed
    focal = min(a.intrinsics_px.fx, b.intrinsics_px.fx)
    ideal = np.diag([focal, focal, 1.0])
    on_a, on_b = focal * on_a, focal * on_b
    E, mask = cv2.findEssentialMat(on_a, on_b, ideal, ideal, None, None, parameters)
    if E is None or E.shape != (3, 3) or np.count_nonzero(mask) < MIN_INLIERS:
        return None
    count, R, t, _ = cv2.recoverPose(E, on_a, on_b, ideal, mask=mask)
    if count < MIN_INLIERS:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t.ravel()
    return T


def _matched(gray_a: Gray, gray_b: Gray) -> tuple[Array, Array]:
    """Pixels (n, 2) of the same features in two images."""
    (pixels_a, features_a), (pixels_b, features_b) = _features(gray_a), _features(gray_b)
    if min(len(pixels_a), len(pixels_b)) < 2:  # noqa: PLR2004
        return np.empty((0, 2)), np.empty((0, 2))
    pairs = cv2.BFMatcher().knnMatch(features_a, features_b, k=2)
    rows = np.array([(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < RATIO * n.distance])
    rows = rows.reshape(-1, 2).astype(np.intp)
    return pixels_a[rows[:, 0]], pixels_b[rows[:, 1]]


def _features(gray: Gray) -> tuple[Array, NDArray[np.float32]]:
    """Pixels (n, 2) and descriptors (n, 128) of an image's features."""
    factor = min(1.0, MAX_SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    points, features = cv2.SIFT.create(nfeatures=MAX_FEATURES).detectAndCompute(small, None)
    if not points:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    scale = np.array([gray.shape[1] / small.shape[1], gray.shape[0] / small.shape[0]])
    pixels = (np.array([p.pt for p in points]) + 0.5) * scale - 0.5
    return pixels, np.asarray(features, dtype=np.float32)
