"""The usual convention errors of a guess (direction, axes, units): each undone and compared."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.protocol import Matcher
from calibgraph.matching.structure import StructureMatcher
from calibgraph.model.geometry import angle_deg, invert
from calibgraph.model.rig import Rig
from calibgraph.progress import no_progress
from calibgraph.trust.thresholds import limit, threshold

Array = NDArray[np.float64]

_DIFFERENT_DEG, _DIFFERENT_M = 15.0, 1.0  # a guess nearer than both to the given one is the same
_FRAMES = 2  # that a corrected guess is matched in

OPTICAL_FROM_BODY = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From axes forward, left, up to a camera's right, down, forward."""


def undo_convention_errors(guess: Array) -> dict[str, Array]:
    """By convention error, in words: the (4, 4) T_camera_lidar of a (4, 4) guess that has it."""
    inverse = invert(guess)
    position, transposed, metres = guess.copy(), guess.copy(), guess.copy()
    inverse_metres = inverse.copy()
    position[:3, 3] = -guess[:3, :3] @ guess[:3, 3]
    transposed[:3, :3] = guess[:3, :3].T
    metres[:3, 3] /= 1000.0
    inverse_metres[:3, 3] /= 1000.0
    return {
        "inverted (it is T_lidar_camera)": inverse,
        "of camera axes forward, left, up, not right, down, forward": OPTICAL_FROM_BODY @ guess,
        "inverted, and of camera axes forward, left, up": OPTICAL_FROM_BODY @ inverse,
        "the camera's position where the LiDAR's in the camera should be": position,
        "a transposed rotation": transposed,
        "a translation in millimetres": metres,
        "inverted, with its translation in millimetres": inverse_metres,
    }


def convention_error_between(guess: Array, result: Array) -> str | None:
    """The convention error of a guess that, undone, leads near the result; in words."""
    corrected = undo_convention_errors(guess)
    distances = {error: _difference(T, result) for error, T in corrected.items()}
    near = {
        error: (round(degrees), round(metres, 1))  # of equally near ones the first, the simplest
        for error, (degrees, metres) in distances.items()
        if degrees < limit("convention_rotation") and metres < limit("convention_translation")
    }
    return min(near, key=lambda error: near[error], default=None)


def likely_intended_guess(dataset: Dataset, guess: Rig) -> str | None:
    """The convention error of a failed guess that, undone, fits the images best; in words.

    Every corrected guess is matched once by the matcher ``structure``, coarsely, in a few frames.

    Returns:
        None if no corrected guess is clearly better, or if the images, which another matcher may
        not need, cannot be read.
    """
    matcher, few = StructureMatcher(), dataset.spread_out(_FRAMES)
    try:
        given = _mean_z_score(few, matcher, guess)
        z_scores = {
            error: _mean_z_score(few, matcher, rig) for error, rig in _corrected_rigs(guess).items()
        }
    except (CalibrationError, OSError):
        return None
    least = max(threshold("z_score").fail, limit("convention_gain") * given)
    best = max(z_scores, key=lambda error: z_scores[error], default=None)
    return best if best is not None and z_scores[best] > least else None


def _corrected_rigs(rig: Rig) -> Mapping[str, Rig]:
    """By convention error: the rig with all its guesses corrected, if that changes them."""
    corrected = {name: undo_convention_errors(T) for name, T in rig.T_camera_lidar.items()}
    rigs = {
        error: rig.moved_to({name: each[error] for name, each in corrected.items()})
        for error in next(iter(corrected.values()))
    }
    return {error: other for error, other in rigs.items() if _differs(rig, other)}


def _differs(one: Rig, two: Rig) -> bool:
    differences = [_difference(T, two.T_camera_lidar[n]) for n, T in one.T_camera_lidar.items()]
    return any(deg > _DIFFERENT_DEG or metres > _DIFFERENT_M for deg, metres in differences)


def _difference(one: Array, two: Array) -> tuple[float, float]:
    """Between two T_camera_lidar: angle [deg], difference of the translations [m]."""
    return angle_deg(one[:3, :3] @ two[:3, :3].T), float(np.linalg.norm(one[:3, 3] - two[:3, 3]))


def _mean_z_score(dataset: Dataset, matcher: Matcher, rig: Rig) -> float:
    """The mean z-score over the cameras; 0 where nothing can be matched."""
    table = matcher.match(dataset, rig, round_index=0, progress=no_progress)
    found = table.findings.z_score
    return float(np.mean([found.get(name, 0.0) for name in rig.cameras]))
