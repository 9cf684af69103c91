"""What is burnt into a camera's images, as a date or a logo: it is filled from around."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Rectangle = tuple[int, int, int, int]

_MARGIN_PX = 16


@dataclass(frozen=True, eq=False)
class BurntIn:
    """What is burnt into a camera's images.

    Attributes:
        mask: (height, width) its pixels.
        rectangles: (left, top, right, bottom) [px] of each thing; right and bottom are outside.
    """

    mask: NDArray[np.bool_]
    rectangles: tuple[Rectangle, ...]

    def fill(self, image: Image) -> Image:
        """The (height, width, 3) image with smooth pixels in its place, which have no features."""
        rows, columns = (np.flatnonzero(self.mask.any(axis=axis)) for axis in (1, 0))
        near = tuple(
            slice(max(0, int(found[0]) - _MARGIN_PX), int(found[-1]) + 1 + _MARGIN_PX)
            for found in (rows, columns)
        )
        mask, filled = self.mask[near], image.copy()
        known = (~mask).astype(np.float32)
        smooth = _fill(filled[near] * known[..., None], known)
        filled[near][mask] = smooth[mask].round().astype(np.uint8)
        return filled


def _fill(weighted: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of what is known; where nothing is, of a smaller image, and so on."""
    known = weight > 0
    means = weighted / np.where(known, weight, 1)[..., None]
    if known.all() or not known.any():
        return np.asarray(means, np.float32)
    half = tuple(-(-side // 2) for side in weight.shape[::-1])
    smaller = [
        np.asarray(cv2.resize(one, half, interpolation=cv2.INTER_AREA), np.float32)
        for one in (weighted, weight)
    ]
    around = cv2.resize(_fill(*smaller), weight.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(known[..., None], means, around)
