"""A gray image prepared for matching: its logarithm, scaled down once for each size."""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.structure.score_kernel import pad
from calibgraph.memory import mmap_copy, mmap_zeros
from calibgraph.model.rig import Camera
from calibgraph.parallel import KeyedCache
from factors.compiled import compiled

Gray = NDArray[np.uint8]
SmallImages = KeyedCache[tuple[Hashable, ...], NDArray[np.float32]]

FINEST_RAD = np.radians(0.03)
"""Of a pixel; half the finest step. Images of 20 megapixels keep a quarter of their pixels."""
LOG_GRAY = np.log1p(np.arange(256, dtype=np.float32))
LEAST_PX = 1e-3  # a smaller share of a pixel counts as none, as in OpenCV


@dataclass(frozen=True, eq=False)
class PreparedImage:
    """A gray image.

    Attributes:
        gray: (height, width), reduced if its pixels are finer than ``FINEST_RAD``.
        smaller: where the scaled images of this and other images are kept.
        identity: by which they know this image.
    """

    gray: Gray
    smaller: SmallImages = field(default_factory=KeyedCache)
    identity: object = field(default_factory=object)

    @staticmethod
    def from_gray(gray: Gray, camera: Camera, smaller: SmallImages | None = None) -> PreparedImage:
        """Prepare an image (height, width) of a camera."""
        factor = int(FINEST_RAD * camera.lens.pixels_per_rad)
        if factor > 1:
            size = camera.width_px // factor, camera.height_px // factor
            gray = mmap_copy(np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA)))
        return PreparedImage(gray, smaller or KeyedCache())

    def log_gray(
        self, camera: Camera, step_rad: float, blur_steps: float
    ) -> tuple[NDArray[np.float32], Array]:
        """Logarithm of gray, down-scaled so that a pixel is a step; its (2,) scales of u and v.

        A pixel p of the image lies at (p + 0.5) scale - 0.5.
        """
        width, height = _scaled_size(camera, step_rad)
        parts = [_shares(*of) for of in zip(self.gray.shape, (height, width), strict=True)]
        small = np.empty((height, width), np.float32)
        _reduce(self.gray, LOG_GRAY, tuple(parts), small)
        small = np.asarray(cv2.GaussianBlur(small, (0, 0), blur_steps), dtype=np.float32)
        return small, np.array([width / camera.width_px, height / camera.height_px])

    def padded_log_gray(
        self, camera: Camera, step_rad: float, blur_steps: float
    ) -> tuple[NDArray[np.float32], Array]:
        """The same, padded for :func:`.score_kernel.score_windows`, and kept."""
        width, height = _scaled_size(camera, step_rad)
        image = self.smaller.get(
            (self.identity, width, height, blur_steps),
            lambda: pad(self.log_gray(camera, step_rad, blur_steps)[0], mmap_zeros),
        )
        return image, np.array([width / camera.width_px, height / camera.height_px])

    def mirrored(self) -> PreparedImage:
        """The image with its left and right swapped."""
        return PreparedImage(np.ascontiguousarray(self.gray[:, ::-1]))

    @property
    def nbytes(self) -> int:
        """Size in memory, without what is scaled of it."""
        return self.gray.nbytes


def _scaled_size(camera: Camera, step_rad: float) -> tuple[int, int]:
    """Width and height of an image whose pixels are a step, or its own."""
    factor = min(1.0, 1.0 / (camera.lens.pixels_per_rad * step_rad))
    return max(8, round(camera.width_px * factor)), max(8, round(camera.height_px * factor))


def _shares(pixels: int, count: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Equal parts of a line: the first pixel of each (count,), and the shares of its pixels.

    (n, count) shares, of the first pixel and of the next ones.
    """
    size = pixels / count
    start = np.arange(count) * size
    first = np.floor(start + LEAST_PX).astype(np.int32)
    at = first + np.arange(math.ceil(size) + 1)[:, None]
    inside = np.minimum(np.minimum(start + size, pixels), at + 1) - np.maximum(start, at)
    shares = np.where(inside > LEAST_PX, inside / np.minimum(size, pixels - start), 0.0)
    return first, shares.astype(np.float32)


@compiled()
def _reduce(gray, values, parts, out):  # type: ignore[no-untyped-def]
    """Fill the means of the pixels' values, by their shares of rows and columns.

    The same bits as OpenCV's INTER_AREA of a look-up table, in less time.
    """
    ((top, down), (left, across)), width, count = parts, gray.shape[1], out.shape[1]
    line, row, held = np.empty(count, np.float32), np.zeros(width + len(across), np.float32), -1
    for j in range(len(out)):
        for t in range(len(down)):
            share, y = down[t, j], top[j] + t
            if share > 0 and y != held:
                held = y
                for x in range(width):
                    row[x] = values[gray[y, x]]
                for i in range(count):
                    line[i] = across[0, i] * row[np.uint64(left[i])]  # which is not negative
                for k in range(1, len(across)):
                    part, after = across[k], row[k:]
                    for i in range(count):
                        line[i] += part[i] * after[np.uint64(left[i])]
            if t == 0:
                for i in range(count):
                    out[j, i] = share * line[i]
            elif share > 0:
                for i in range(count):
                    out[j, i] += share * line[i]
