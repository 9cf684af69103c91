"""Does the network measure, or does it repeat what it started from, or what it was trained on?

Matches are only worth something if they do not depend on the start: from a start that is displaced
by a known motion, a point must be matched to the same pixel. A network that gives back its start
(an untrained one does) moves its matches along; its frames agree, and its residuals are small, so
that nothing else would show it. And without the image it must NOT find the way back: if it does, it
has learned the extrinsic of its training by heart instead of comparing image and cloud.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera

Array = NDArray[np.float64]
BLANK = (124, 116, 104)
"""The mean colour of the networks' training: zero, once normalised."""

_SHARE_OF_RANGE = 0.7  # displacement per axis, of what the network was trained to correct
_DEFAULT_RANGE = (0.2, 0.05)  # degrees and metres: the finest published network's
_MIN_POINTS = 50


def displaced(
    T_camera_lidar: Array, range_deg_m: tuple[float, float] | None, rng: np.random.Generator
) -> Array:
    """A start within the network's range of a pose: each axis turned and shifted, up or down."""
    rotation_deg, translation_m = range_deg_m or _DEFAULT_RANGE
    signs = rng.choice([-1.0, 1.0], 6)
    D = np.eye(4)
    angles = _SHARE_OF_RANGE * rotation_deg * signs[:3]
    D[:3, :3] = Rotation.from_rotvec(angles, degrees=True).as_matrix()
    D[:3, 3] = _SHARE_OF_RANGE * translation_m * signs[3:]
    return np.asarray(D @ T_camera_lidar)


def remaining_share(
    camera: Camera, T_base: Array, T_displaced: Array, matches: Correspondences
) -> float:
    """How much of a displacement is left in the matches that were found from it.

    Args:
        camera: its lens.
        T_base: (4, 4) T_camera_lidar that the network led to before.
        T_displaced: (4, 4) the start of these matches.
        matches: of one frame.

    Returns:
        The slope of the matches' distance from the base over the start's: 0 for a network that
        measures, 1 for one that gives back its start; NaN with too few matches.
    """
    points = matches.points_lidar_m
    base, start = (
        camera.lens.project(points @ T[:3, :3].T + T[:3, 3])[0] for T in (T_base, T_displaced)
    )
    moved, left = start - base, matches.pixels_px - base
    if len(points) < _MIN_POINTS:
        return float("nan")
    return float((left * moved).sum() / (moved**2).sum())
