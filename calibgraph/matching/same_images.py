"""Cameras with the same images: one device under two names, or a folder that was copied.

A calibration finds where the images are taken from, so that nothing in it shows whose they are. One
image and a copy of it, scaled, cropped, brighter or compressed again, fit everywhere by one shift,
scale and turn, in all frames alike. Two cameras see what is near at other places beside what is
far, even side by side: over a road that is a shear, which copies do not have.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Rig
from calibgraph.parallel import map_on_cores

_FRAMES = 3
_SIDE_PX, _FEATURES = 400, 800  # of the reduced images
_NEAR_PX, _LEAST_MATCHES = 2.0, 12
_MOST_SHEAR = 0.02
"""Cosine between the axes of a fit: 0 for copies, 0.1 for the stereo pair of KITTI on a road."""
_BLOCK_PX, _LEAST_CONTRAST, _LEAST_BLOCKS = 16, 6.0, 12
_LEAST_CORRELATION, _BELOW = 0.75, 25
"""Percentile of the blocks' correlation. Stereo pairs of seven drives had 0.6 at most, copies with
a shift of brightness, noise or a crop to half the sides 0.8 and more."""
_SAME_PX = 6.0  # by which the fits of two frames may differ in a corner


class _View(NamedTuple):
    """A reduced image with its features: (n, 2) places and (n, 32) descriptors."""

    gray: NDArray[np.uint8]
    points: NDArray[np.float32]
    descriptors: NDArray[np.uint8]


def require_different_images(data: Dataset, rig: Rig) -> None:
    """Raise a DatasetError if two cameras have the same images; see :func:`find_same_images`."""
    if found := find_same_images(data, rig):
        raise DatasetError("; ".join(found))


def find_same_images(data: Dataset, rig: Rig) -> list[str]:
    """A line per pair of cameras that have the same images, in one frame or a frame apart.

    Three frames are compared, and in the middle also neighbours. What cannot be read, or shows too
    little, is passed over.
    """
    names = list(rig.cameras)
    if len(names) < 2:  # noqa: PLR2004
        return []
    at = spread_out(data.frames, _FRAMES)
    middle = at[len(at) // 2]
    near = [data.neighbour(middle, step) for step in (-1, 1)]
    frames = {frame.index: frame for frame in (*at, *near) if frame is not None}
    jobs = [(frame, name) for frame in frames.values() for name in names]
    made = map_on_cores(_view, *zip(*jobs, strict=True), [rig] * len(jobs))
    views = {(f.index, name): view for (f, name), view in zip(jobs, made, strict=True)}
    lines = []
    for a, b in combinations(names, 2):
        for later in (0, -1, 1):
            shown = [f.index for f in (at if later == 0 else frames.values())]
            pairs = [(views[i, a], views.get((i + later, b))) for i in shown]
            if _are_same([(one, two) for one, two in pairs if one and two]):
                lines.append(
                    f"{a} and {b} have the same images{', a frame apart' if later else ''}: one "
                    "device under two names, or a copied folder; give each camera its own images, "
                    "or take one out of the rig"
                )
                break
    return lines


def _view(frame: Frame, name: str, rig: Rig) -> _View | None:
    try:
        gray = frame.load_gray(name, rig.cameras[name])
    except (CalibrationError, OSError, KeyError):  # reported where it is needed
        return None
    factor = min(1.0, _SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.ORB.create(_FEATURES, fastThreshold=10).detectAndCompute(small, None)
    if len(points) < _LEAST_MATCHES:
        return None
    return _View(
        np.asarray(cv2.blur(small, (3, 3)), np.uint8),  # of noise, and of compression
        np.array([point.pt for point in points], np.float32),
        np.asarray(descriptors, np.uint8),
    )


def _are_same(pairs: Sequence[tuple[_View, _View]]) -> bool:
    """Whether two cameras' images of most frames fit, all of them by one map."""
    fits: list[Array] = []
    for number, (one, two) in enumerate(pairs):
        if 2 * (number - len(fits)) >= len(pairs):  # the others cannot be most
            return False
        fit = _fit(one, two)
        fits += [] if fit is None else [fit]
    if 2 * len(fits) <= len(pairs):
        return False
    sides = np.array([[0, 0, 1], [_SIDE_PX, 0, 1], [0, _SIDE_PX, 1]], dtype=np.float64)
    return bool(np.ptp([sides @ fit.T for fit in fits], axis=0).max() <= _SAME_PX)


def _fit(one: _View, two: _View) -> Array | None:
    """(2, 3) the map from the second image to the first, if it is a copy of it."""
    # the bits that differ, of nearest to each other: half the time of OpenCV's matcher
    words = zip(one.descriptors.view(np.uint64).T, two.descriptors.view(np.uint64).T, strict=True)
    apart = sum(np.bitwise_count(a[:, None] ^ b).astype(np.uint16) for a, b in words)
    nearest = np.argmin(apart, axis=1)
    mutual = np.flatnonzero(np.argmin(apart, axis=0)[nearest] == np.arange(len(nearest)))
    if len(mutual) < _LEAST_MATCHES:
        return None
    a, b = one.points[mutual], two.points[nearest[mutual]]
    M, inlier = cv2.estimateAffine2D(b, a, ransacReprojThreshold=_NEAR_PX)
    if M is None or np.count_nonzero(inlier) < _LEAST_MATCHES:
        return None
    fit = np.asarray(M, dtype=np.float64)
    axes = fit[:, :2] / np.linalg.norm(fit[:, :2], axis=0)
    if abs(axes[:, 0] @ axes[:, 1]) > _MOST_SHEAR:
        return None
    return fit if _correlation(one, two, fit) >= _LEAST_CORRELATION else None


def _correlation(one: _View, two: _View, M: Array) -> float:
    """The percentile of the correlation of the blocks of both images that are not flat."""
    size = one.gray.shape[::-1]
    warped = cv2.warpAffine(two.gray, M, size)
    inside = cv2.warpAffine(np.ones_like(two.gray), M, size, flags=cv2.INTER_NEAREST)
    x, y = one.gray.astype(np.float32), warped.astype(np.float32)
    x_mean, y_mean = _block_means(x), _block_means(y)
    xx, yy = _block_means(x * x) - x_mean**2, _block_means(y * y) - y_mean**2
    whole = _block_means(inside.astype(np.float32)) > 1 - 1e-3
    structured = whole & (xx > _LEAST_CONTRAST**2) & (yy > 0.1 * _LEAST_CONTRAST**2)
    if np.count_nonzero(structured) < _LEAST_BLOCKS:
        return 0.0
    together = (_block_means(x * y) - x_mean * y_mean)[structured]
    return float(np.percentile(together / np.sqrt((xx * yy)[structured]), _BELOW))


def _block_means(values: NDArray[np.float32]) -> NDArray[np.float32]:
    means = cv2.blur(values, (_BLOCK_PX, _BLOCK_PX))
    half = _BLOCK_PX // 2
    return np.asarray(means[half::_BLOCK_PX, half::_BLOCK_PX])
