"""A gray image prepared for matching: its logarithm, scaled down once for each size."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.structure.score_kernel import pad
from calibgraph.memory import mmap_copy
from calibgraph.model.rig import Camera
from calibgraph.parallel import KeyedCache

Gray = NDArray[np.uint8]
Derived = KeyedCache[tuple[Hashable, ...], Any]
"""What is kept of images and clouds, by keys whose first entry is the identity of one."""

FINEST_RAD = np.radians(0.03)
"""Of a pixel; half the finest step. Images of 20 megapixels keep a quarter of their pixels."""
_PARTS, _NOISE = (16, 16), 2
"""Of an image; gray levels between means of parts: 222 images of recordings have 84 and more."""
LOG_GRAY = np.log1p(np.arange(256, dtype=np.float32))


@dataclass(frozen=True, eq=False)
class PreparedImage:
    """A gray image.

    Attributes:
        gray: (height, width), reduced if its pixels are finer than ``FINEST_RAD``.
        derived: where the scaled images of this and other images are kept.
        identity: by which it knows this image.
    """

    gray: Gray
    derived: Derived = field(default_factory=KeyedCache)
    identity: object = field(default_factory=object)

    @staticmethod
    def from_gray(gray: Gray, camera: Camera, derived: Derived | None = None) -> PreparedImage:
        """Prepare an image (height, width) of a camera."""
        factor = int(FINEST_RAD * camera.lens.pixels_per_rad)
        if factor > 1:
            size = camera.width_px // factor, camera.height_px // factor
            gray = mmap_copy(np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA)))
        return PreparedImage(gray, derived or KeyedCache())

    def log_gray(
        self, camera: Camera, step_rad: float, blur_steps: float
    ) -> tuple[NDArray[np.float32], Array]:
        """Logarithm of gray, down-scaled so that a pixel is a step; its (2,) scales of u and v.

        A pixel p of the image lies at (p + 0.5) scale - 0.5. The mean is 0, and the image is padded
        for :func:`.score_kernel.score_windows`.
        """
        factor = min(1.0, 1.0 / (camera.lens.pixels_per_rad * step_rad))
        whole = camera.width_px, camera.height_px
        size = max(8, round(factor * whole[0])), max(8, round(factor * whole[1]))

        def scale() -> NDArray[np.float32]:
            small = cv2.resize(cv2.LUT(self.gray, LOG_GRAY), size, interpolation=cv2.INTER_AREA)
            return pad(np.asarray(cv2.GaussianBlur(small, (0, 0), blur_steps)))

        return self.derived.get((self.identity, *size, blur_steps), scale), np.divide(size, whole)

    @property
    def shows_something(self) -> bool:
        """Whether parts of the image differ by more than noise: not with the lens covered."""
        parts = cv2.resize(self.gray, _PARTS, interpolation=cv2.INTER_AREA)
        return int(np.ptp(parts)) > _NOISE

    def mirrored(self) -> PreparedImage:
        """The image with its left and right swapped."""
        return PreparedImage(np.ascontiguousarray(self.gray[:, ::-1]))

    @property
    def nbytes(self) -> int:
        """Size in memory, without what is scaled of it."""
        return self.gray.nbytes
