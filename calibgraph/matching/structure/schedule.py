"""The coarse-to-fine schedule: the reach and the resolution of each round, as angles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Level:
    """Reach and resolution of one level of the schedule.

    Attributes:
        step_rad: step of the grid of shifts, and pixel of the down-scaled image.
        reach_rad: largest shift that is scored.
        rotation_rad, translation_m: half-widths of the pose search, per axis.
        spacing_rad: spacing of the LiDAR samples in a window.
        fine: score for accuracy, not for reach. Windows that hold an occluded point are left out
            (unbiased); a coarse level leaves out only the point (more windows, which it needs
            where sensors are far apart). Windows keep their linear parts. Their log-likelihoods
            are summed, so that one window that fits well outweighs many that fit somewhat.
        weighed: count windows by their weights, see :mod:`.window_weights`.
        stride_spacings: spacing of the windows, in sample spacings.
        blur_steps: standard deviation of the Gaussian blur of the image, in steps.
        group_rad: cell of directions in which the shift is nearly constant.
        max_windows: per camera, over all frames: bounds the time. More windows average more of
            the image; errors that all windows of a place share remain.
        searches: number of pose searches; the best counts. One is enough where a single
            maximum is in reach.
        min_quality: least mean score of a group's windows at its peak, above the grid's mean.
    """

    step_rad: float
    reach_rad: float
    rotation_rad: float
    translation_m: float
    spacing_rad: float
    fine: bool = False
    weighed: bool = False
    stride_spacings: float = 2.0
    blur_steps: float = 1.0
    group_rad: float = np.radians(3.8)
    max_windows: int = 20_000
    searches: int = 3
    min_quality: float = 0.05


def _level(
    step_deg: float,
    reach_deg: float,
    *,
    rotation_deg: float,
    translation_m: float,
    spacing_deg: float,
    fine: bool,
) -> Level:
    return Level(
        step_rad=np.radians(step_deg),
        reach_rad=np.radians(reach_deg),
        rotation_rad=np.radians(rotation_deg),
        translation_m=translation_m,
        spacing_rad=np.radians(spacing_deg),
        fine=fine,
        weighed=fine,
        searches=1 if fine else 3,
    )


WIDE = _level(0.5, 10.0, rotation_deg=7.0, translation_m=1.2, spacing_deg=0.6, fine=False)
"""From errors of about 4 degrees and 0.8 m, where a search ends, to 1 degree and 0.3 m."""


def _last(level: Level) -> Level:
    """The level with more windows, in smaller groups, and a higher quality demanded of them."""
    return replace(level, group_rad=np.radians(2.0), max_windows=30_000, min_quality=0.1)


LEVELS = (
    _level(0.25, 4.5, rotation_deg=2.5, translation_m=0.25, spacing_deg=0.35, fine=False),
    _level(0.20, 2.5, rotation_deg=1.2, translation_m=0.25, spacing_deg=0.30, fine=False),
    _level(0.14, 1.8, rotation_deg=0.7, translation_m=0.20, spacing_deg=0.20, fine=False),
    _level(0.10, 1.2, rotation_deg=0.7, translation_m=0.25, spacing_deg=0.14, fine=True),
    _last(_level(0.06, 0.8, rotation_deg=0.7, translation_m=0.25, spacing_deg=0.14, fine=True)),
    _last(_level(0.06, 0.6, rotation_deg=0.7, translation_m=0.25, spacing_deg=0.14, fine=True)),
)
"""From errors of about 2.5 degrees and 25 cm down to the resolution of a camera pixel.

The last levels search as widely as those before: in a narrow search the prior would hold a camera
at its start."""
