"""The rounds of the matcher: how far it looks, and how finely. All in angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Level:
    """One round's reach and resolution.

    Attributes:
        step_rad: step of the grid of shifts, and pixel of the down-scaled image.
        reach_rad: largest shift that is scored.
        rotation_rad, translation_m: half-widths of the pose search, per axis.
        spacing_rad: spacing of the LiDAR samples in a window.
        strict: leave out windows that hold an occluded point (unbiased), not only the point (more
            windows: what the coarse search needs where sensors are far apart).
        stride_spacings: spacing of the windows, in sample spacings.
        blur_steps: Gaussian blur of the image, in steps.
    """

    step_rad: float
    reach_rad: float
    rotation_rad: float
    translation_m: float
    spacing_rad: float
    strict: bool = False
    stride_spacings: float = 2.0
    blur_steps: float = 1.0


def _level(
    step_deg: float,
    reach_deg: float,
    rotation_deg: float,
    translation_m: float,
    spacing_deg: float,
    strict: bool,
) -> Level:
    return Level(
        step_rad=np.radians(step_deg),
        reach_rad=np.radians(reach_deg),
        rotation_rad=np.radians(rotation_deg),
        translation_m=translation_m,
        spacing_rad=np.radians(spacing_deg),
        strict=strict,
    )


LEVELS = (
    _level(0.25, 4.5, 2.5, 0.25, 0.35, False),
    _level(0.20, 2.5, 1.2, 0.25, 0.30, False),
    _level(0.14, 1.8, 0.7, 0.20, 0.20, False),
    _level(0.10, 1.2, 0.4, 0.15, 0.14, True),
    _level(0.08, 0.8, 0.3, 0.10, 0.14, True),
    _level(0.08, 0.6, 0.2, 0.06, 0.14, True),
)
"""From errors of about 2.5 degrees and 25 cm down to the resolution of a camera pixel."""
