"""The rounds of the matcher: how far it looks, and how finely. All in angles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Level:
    """One round's reach and resolution.

    Attributes:
        step_rad: step of the grid of shifts, and pixel of the down-scaled image.
        reach_rad: largest shift that is scored.
        rotation_rad, translation_m: half-widths of the pose search, per axis.
        spacing_rad: spacing of the LiDAR samples in a window.
        strict: score for accuracy, not for reach: leave out windows that hold an occluded point
            (unbiased), not only the point (more windows: what the coarse search needs where
            sensors are far apart); let windows keep their linear parts; and score their
            log-likelihood, so that one that fits well outweighs many that fit somewhat.
        stride_spacings: spacing of the windows, in sample spacings.
        blur_steps: Gaussian blur of the image, in steps.
        group_rad: cell of directions in which the shift is nearly one.
        max_windows: per camera, over all frames: bounds the time. More of them average more of the
            image; what one place shows cannot be averaged out.
        searches: how often the pose is searched; the best counts. Once is enough where one
            maximum is in reach.
        min_quality: least mean score of a group's windows at its peak, above the grid's mean.
    """

    step_rad: float
    reach_rad: float
    rotation_rad: float
    translation_m: float
    spacing_rad: float
    strict: bool = False
    stride_spacings: float = 2.0
    blur_steps: float = 1.0
    group_rad: float = np.radians(3.8)
    max_windows: int = 20_000
    searches: int = 3
    min_quality: float = 0.05


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
        searches=1 if strict else 3,
    )


def _final(level: Level) -> Level:
    """More windows, in smaller groups, of which only clear ones count."""
    return replace(level, group_rad=np.radians(2.0), max_windows=30_000, min_quality=0.1)


LEVELS = (
    _level(0.25, 4.5, 2.5, 0.25, 0.35, False),
    _level(0.20, 2.5, 1.2, 0.25, 0.30, False),
    _level(0.14, 1.8, 0.7, 0.20, 0.20, False),
    _level(0.10, 1.2, 0.7, 0.25, 0.14, True),
    _final(_level(0.06, 0.8, 0.7, 0.25, 0.14, True)),
    _final(_level(0.06, 0.6, 0.7, 0.25, 0.14, True)),
)
"""From errors of about 2.5 degrees and 25 cm down to the resolution of a camera pixel.

The last searches stay wide: in narrow ones the prior would hold the poses where they began."""
