"""Features of one image: SIFT keypoints and descriptors, with the rays of the keypoints."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Camera
from factors import unproject

Gray = NDArray[np.uint8]

MAX_SIDE_PX = 800
"""Larger images are reduced. On KITTI, relative poses are as good as with all pixels, in a third of
the time; on images of 1600 to 1936 px there are as many matches or more. A search, and the motion
of the vehicle, would do with less, but find the features of some frames there."""
MAX_FEATURES = 4000  # per image
LOWE_RATIO = 0.8  # of the distances of the best and the second best match, at most


@dataclass(frozen=True, eq=False)
class Features:
    """Features of one image.

    Attributes:
        pixels_px: (n, 2) column and row.
        rays: (n, 3) unit viewing rays in the camera frame.
        descriptors: (n, 128) float32.
    """

    pixels_px: Array
    rays: Array
    descriptors: NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        """Size in memory."""
        return self.pixels_px.nbytes + self.rays.nbytes + self.descriptors.nbytes

    def select(self, rows: NDArray[np.intp]) -> Features:
        """Some of the features, by their rows."""
        return Features(self.pixels_px[rows], self.rays[rows], self.descriptors[rows])


def features_of(frame: Frame, name: str, camera: Camera) -> Features:
    """The features of a camera's image of a frame, see :func:`detect_features`.

    Raises:
        FileError: if the image cannot be read.
    """
    lens = camera.lens
    return frame.derive(
        ("features", name, lens.kind, lens.packed.tobytes()),
        lambda: detect_features(frame.load_gray(name, camera), camera),
    )


def detect_features(gray: Gray, camera: Camera) -> Features:
    """SIFT features of an image that lie on rays of the lens, one per place."""
    factor = min(1.0, MAX_SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    # Without the precise upscaling, keypoints are off by a quarter of a pixel.
    sift = cv2.SIFT.create(nfeatures=MAX_FEATURES, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(small, None)
    if not points:
        return Features(np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 128), np.float32))
    scale = np.array([gray.shape[1] / small.shape[1], gray.shape[0] / small.shape[0]])
    pixels = (np.array([point.pt for point in points]) + 0.5) * scale - 0.5
    # A keypoint with several orientations comes several times; they are no independent matches.
    rows = np.sort(np.unique(pixels.round(2), axis=0, return_index=True)[1])
    rays, valid = unproject(camera.lens, pixels[rows])
    rows, rays = rows[valid], rays[valid]
    return Features(pixels[rows], rays, np.asarray(descriptors, np.float32)[rows])


def match_features(a: Features, b: Features) -> NDArray[np.intp]:
    """(m, 2) rows of the features of A and B that are each other's best match, clearly.

    Clearly: the second best of B is farther from A's feature by the ratio of Lowe (2004).
    """
    if min(len(a.rays), len(b.rays)) < 2:  # noqa: PLR2004
        return np.empty((0, 2), np.intp)
    unit = [f.descriptors / np.linalg.norm(f.descriptors, axis=1, keepdims=True) for f in (a, b)]
    cosine = unit[0] @ unit[1].T
    rows, best = np.arange(len(cosine)), cosine.argmax(axis=1)
    first, of_b = cosine[rows, best].copy(), cosine.max(axis=0)
    cosine[rows, best] = -1.0
    second = cosine.max(axis=1)
    clear = 1.0 - first < LOWE_RATIO**2 * (1.0 - second)  # half the squares of the distances
    kept = np.flatnonzero(clear & (of_b[best] == first))
    kept = kept[np.sort(np.unique(best[kept], return_index=True)[1])]  # the first of the same
    return np.column_stack([kept, best[kept]])
