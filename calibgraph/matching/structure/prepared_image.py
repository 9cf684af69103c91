"""A gray image prepared for matching: its logarithm, scaled down once for each size."""

from __future__ import annotations

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

Gray = NDArray[np.uint8]
SmallImages = KeyedCache[tuple[Hashable, ...], NDArray[np.float32]]

FINEST_RAD = np.radians(0.03)
"""Of a pixel; half the finest step. Images of 20 megapixels keep a quarter of their pixels."""
LOG_GRAY = np.log1p(np.arange(256, dtype=np.float32))


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
        width, height = size = _scaled_size(camera, step_rad)
        small = cv2.resize(cv2.LUT(self.gray, LOG_GRAY), size, interpolation=cv2.INTER_AREA)
        blurred = np.asarray(cv2.GaussianBlur(small, (0, 0), blur_steps), dtype=np.float32)
        return blurred, np.array([width / camera.width_px, height / camera.height_px])

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
