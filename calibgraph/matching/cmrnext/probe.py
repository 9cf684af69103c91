"""Probes of a network: do its matches depend on the start, or on the extrinsic of its training?

From a start displaced by a known motion, a point must be matched to the same pixel. An untrained
network returns its start: its matches move with it, consistently over all frames and with small
residuals, so that no other check detects it. With a blank image the way back must not be found: a
network that finds it has memorised the extrinsic of its training.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera

BLANK = (124, 116, 104)
"""The mean colour of the networks' training: zero, once normalised."""

_SHARE_OF_RANGE = 0.7  # displacement per axis, as a share of the training's perturbation
_DEFAULT_RANGE = (0.2, 0.05)  # degrees and metres: the finest published network's
_MIN_POINTS = 50


def displace(
    T_camera_lidar: Array, range_deg_m: tuple[float, float] | None, rng: np.random.Generator
) -> Array:
    """(4, 4) a start within the network's range: per axis a rotation and a shift of random sign."""
    rotation_deg, translation_m = range_deg_m or _DEFAULT_RANGE
    signs = rng.choice([-1.0, 1.0], 6)
    turn = Rotation.from_rotvec(_SHARE_OF_RANGE * rotation_deg * signs[:3], degrees=True)
    D = transform(turn, _SHARE_OF_RANGE * translation_m * signs[3:])
    return np.asarray(D @ T_camera_lidar)


def remaining_share(
    camera: Camera, T_base: Array, T_displaced: Array, matches: Correspondences
) -> float:
    """Share of a displacement that remains in the matches found from it.

    Args:
        camera: with its lens.
        T_base: (4, 4) T_camera_lidar estimated by the network before.
        T_displaced: (4, 4) T_camera_lidar from which the matches were found.
        matches: of one frame.

    Returns:
        Slope of the matches' displacement over the start's, both in pixels from the base: 0 if
        the matches are independent of the start, 1 if they follow it; NaN with too few matches.
    """
    points = matches.points_lidar_m
    base, start = (
        camera.lens.project(points @ T[:3, :3].T + T[:3, 3])[0] for T in (T_base, T_displaced)
    )
    displacement, remainder = start - base, matches.pixels_px - base
    if len(points) < _MIN_POINTS:
        return float("nan")
    return float((remainder * displacement).sum() / (displacement**2).sum())
