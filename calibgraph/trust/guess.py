"""What a guess may have meant: the usual mistakes of direction, axes and units, undone."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.protocol import Matcher
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import angle_deg, invert, pose_difference, relative_transform
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check, above, below
from calibgraph.progress import no_progress
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.trust.solution_checks import CONTRAST_FAIL

Array = NDArray[np.float64]

FAR_GUESS_DEG, FAR_GUESS_M = 30.0, 2.0
"""A result farther than this from the guess, and than its matcher searches: the guess was of
another convention."""

SHIFT_WARN_M, SHIFT_FAIL_M = 20.0, 100.0
RANGE_WARN_M, RANGE_FAIL_M = 200.0, 1000.0
"""Longer than vehicles, farther than LiDARs see."""

RANGE_USED_WARN, RANGE_USED_FAIL = 1.2, 4.0
"""How far from the guess a result may lie, in ranges of its matcher."""

SWAPPED_SLACK = 0.1  # m and rad together: what results are off by says nothing of a swap
SWAPPED_WARN, SWAPPED_FAIL = 0.7, 0.5
"""Distance of two results from each other's guesses, over that from their own. Of 1000 guesses of
KITTI's pair each, within 2 to 20 deg and 0.2 to 1.5 m, up to 0.2 % are under 0.7 and none under
0.5; with images swapped 99 and 79 % of those within 2 deg, 0.2 m."""

_MEANT_DEG, _MEANT_M = 30.0, 2.5  # a reading this near to the result is what was meant
_NEAR_DEG, _NEAR_M = 15.0, 1.0

_READING_FRAMES = 2
_CLEARER = 1.3  # times the z-score of the guess as it is

OPTICAL_FROM_BODY = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From axes forward, left, up to a camera's right, down, forward."""


def readings(T: Array) -> dict[str, Array]:
    """What a (4, 4) guess would be, were it meant otherwise: in words, T_camera_lidar."""
    inverse = invert(T)
    position, transposed, metres, inverse_metres = T.copy(), T.copy(), T.copy(), inverse.copy()
    position[:3, 3] = -T[:3, :3] @ T[:3, 3]
    transposed[:3, :3] = T[:3, :3].T
    metres[:3, 3] /= 1000.0
    inverse_metres[:3, 3] /= 1000.0
    return {
        "inverted (it is T_lidar_camera)": inverse,
        "of camera axes forward, left, up, not right, down, forward": OPTICAL_FROM_BODY @ T,
        "inverted, and of camera axes forward, left, up": OPTICAL_FROM_BODY @ inverse,
        "the camera's position where the LiDAR's in the camera should be": position,
        "a transposed rotation": transposed,
        "a translation in millimetres": metres,
        "inverted, with its translation in millimetres": inverse_metres,
    }


def guess_checks(guess: Array, result: Array, findings: MatcherFindings) -> list[Check]:
    """Whether a camera's result is so far from the guess that the guess was meant otherwise.

    Args:
        guess: (4, 4) T_camera_lidar.
        result: (4, 4) what came out.
        findings: of the matcher, with its range.
    """
    degrees, metres = _apart(guess, result)
    far_deg = max(FAR_GUESS_DEG, math.sqrt(3) * (findings.range_rotation_deg or 0.0))
    far_m = max(FAR_GUESS_M, math.sqrt(3) * (findings.range_translation_m or 0.0))
    meant = nearest_reading(guess, result)
    advice = f"it seems to be {meant}" if meant else "is T_camera_lidar inverted, or of other axes?"
    name, shift_m = "distance from the guess", float(np.linalg.norm(guess[:3, 3]))
    units = "is the translation of T_camera_lidar in millimetres?"
    return [
        above(name, degrees, far_deg, 360.0, "deg", advice),
        above(name, metres, far_m, np.inf, "m", advice),
        above("the guess's translation", shift_m, SHIFT_WARN_M, SHIFT_FAIL_M, "m", units),
    ]


def swap_check(
    camera: str, guesses: Mapping[str, Array], results: Mapping[str, Array]
) -> list[Check]:
    """Whether a camera and another ended where the other's guess is; nothing for one camera.

    Args:
        camera: its name.
        guesses: (4, 4) T_camera_lidar, by camera.
        results: what came out, by camera.
    """

    def way(*pairs: tuple[str, str]) -> float:
        return SWAPPED_SLACK + sum(_way(guesses[one], results[two]) for one, two in pairs)

    shares = {
        other: way((other, camera), (camera, other)) / way((camera, camera), (other, other))
        for other in results
        if other != camera
    }
    if not shares:
        return []
    other = min(shares, key=lambda name: shares[name])
    name = f"distance of it and {other} from each other's guess, over that from their own"
    advice = "are their images swapped, or their poses in the rig?"
    return [below(name, shares[other], SWAPPED_WARN, SWAPPED_FAIL, "", advice)]


def range_checks(guess: Array, result: Array, findings: MatcherFindings) -> list[Check]:
    """Whether a result lies within what its matcher looks at, if it says how far that is.

    Args:
        guess: (4, 4) from where the matcher started.
        result: (4, 4) what came out.
        findings: of the matcher, with its range.
    """
    step = relative_transform(result, guess)
    moved = {
        "range_rotation_deg": np.degrees(Rotation.from_matrix(step[:3, :3]).as_rotvec()),
        "range_translation_m": step[:3, 3],
    }
    advice = "start again from the result, and see whether it stays"
    return [
        above(
            f"largest {key.split('_')[1]} from the guess, by the matcher's range",
            float(np.abs(moved[key]).max() / max(limit, 1e-9)),
            RANGE_USED_WARN, RANGE_USED_FAIL, "times", advice,
        )
        for key in moved
        if (limit := getattr(findings, key)) is not None
    ]  # fmt: skip


def points_check(matches: CameraBlock) -> Check:
    """Whether the points can be in metres."""
    range_m = float(np.median(np.linalg.norm(matches.block.points_lidar_m, axis=1)))
    name, advice = "median distance of the points", "are the clouds in millimetres?"
    return above(name, range_m, RANGE_WARN_M, RANGE_FAIL_M, "m", advice)


def nearest_reading(guess: Array, result: Array) -> str | None:
    """Which reading of the guess the result lies near, if any."""
    distances = {words: _apart(T, result) for words, T in readings(guess).items()}
    near = {
        words: (round(degrees), round(metres, 1))  # of alike ones the first, the simplest, is meant
        for words, (degrees, metres) in distances.items()
        if degrees < _MEANT_DEG and metres < _MEANT_M
    }
    return min(near, key=lambda words: near[words], default=None)


def reread(rig: Rig) -> Mapping[str, Rig]:
    """The rig with all its guesses read otherwise, in words: those that make a difference."""
    poses = {name: readings(T) for name, T in rig.T_camera_lidar.items()}
    rigs = {
        words: rig.moved_to({name: each[words] for name, each in poses.items()})
        for words in next(iter(poses.values()))
    }
    return {words: other for words, other in rigs.items() if _differs(rig, other)}


def _differs(one: Rig, two: Rig) -> bool:
    apart = [_apart(T, two.T_camera_lidar[name]) for name, T in one.T_camera_lidar.items()]
    return any(degrees > _NEAR_DEG or metres > _NEAR_M for degrees, metres in apart)


def _apart(one: Array, two: Array) -> tuple[float, float]:
    """Between two T_camera_lidar: angle [deg], difference of the translations [m]."""
    return angle_deg(one[:3, :3] @ two[:3, :3].T), float(np.linalg.norm(one[:3, 3] - two[:3, 3]))


def _way(one: Array, two: Array) -> float:
    """Between two T_camera_lidar: of the camera's centre [m], and the angle [rad], together."""
    degrees, centimetres = pose_difference(one, two)
    return float(np.radians(degrees)) + centimetres / 100


def likely_intended_guess(dataset: Dataset, guess: Rig) -> str | None:
    """How a guess that led nowhere may have been meant, by what fits the images; in words.

    Every reading is matched once by the matcher `structure`, coarsely, in a few frames. None if
    no reading is clearly better, or if the images, which another matcher may not need, cannot be
    read.
    """
    from calibgraph.matching.structure import StructureMatcher

    matcher = StructureMatcher()
    few = dataset.spread_out(_READING_FRAMES)
    try:
        least = max(CONTRAST_FAIL, _CLEARER * _mean_z_score(few, matcher, guess))
        contrasts = {
            words: _mean_z_score(few, matcher, rig) for words, rig in reread(guess).items()
        }
    except (CalibrationError, OSError):
        return None
    best = max(contrasts, key=lambda words: contrasts[words], default=None)
    return best if best is not None and contrasts[best] > least else None


def _mean_z_score(dataset: Dataset, matcher: Matcher, rig: Rig) -> float:
    """The mean contrast over the cameras; 0 where nothing can be matched."""
    table = matcher.match(dataset, rig, round_index=0, progress=no_progress)
    found = table.findings.z_score
    return float(np.mean([found.get(name, 0.0) for name in rig.cameras]))
