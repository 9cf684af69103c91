"""The common convention errors of a guess (direction, axes, units): each undone and compared."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.structure.acceptance import are_accepted, least_z_score
from calibgraph.matching.structure.frame_cache import FrameCache, cache_of, load_camera_frames
from calibgraph.matching.structure.global_search import ALONE
from calibgraph.matching.structure.matcher import SEARCH_DEG, SEARCH_M
from calibgraph.matching.structure.pose_refinement import (
    HOPELESS,
    CameraFrames,
    Candidate,
    approach,
    refine,
)
from calibgraph.model.geometry import T_OPTICAL_LINK, angle_deg, invert, transform
from calibgraph.model.rig import Rig
from calibgraph.parallel import core_pool
from calibgraph.trust.thresholds import limit

_FRAMES = 3  # that a corrected guess is matched in
_CAMERAS = 3  # of a rig, that they are tried for
_NEAR_DEG, _NEAR_M = 5.0, 0.5  # poses nearer than both are tried once
_AS_NEAR = 0.2  # of the limits of distance: as near, of rough guesses
_REFINED = 2  # of the corrected guesses
_LEAST_POINTS = 300  # of a cloud in the image, so that windows of it can agree


def undo_convention_errors(guess: Array) -> dict[str, Array]:
    """Per convention error, in words: the (4, 4) T_camera_lidar of a (4, 4) guess that has it."""
    inverse = invert(guess)
    position, transposed = guess.copy(), guess.copy()
    position[:3, 3] = -guess[:3, :3] @ guess[:3, 3]
    transposed[:3, :3] = guess[:3, :3].T
    x, y, z, w = Rotation.from_matrix(guess[:3, :3]).as_quat()
    return {
        "the guess is inverted (it is T_lidar_camera)": inverse,
        "the guess is of camera axes forward, left, up, not right, down, forward": (
            T_OPTICAL_LINK @ guess
        ),
        "the guess is inverted, and of camera axes forward, left, up": T_OPTICAL_LINK @ inverse,
        "the LiDAR's axes are turned by 180 deg about z (its x points backward)": (
            guess @ _turned(180.0)
        ),
        "the LiDAR's axes are turned by 90 deg about z (its x points right)": (
            guess @ _turned(-90.0)
        ),
        "the LiDAR's axes are turned by 90 deg about z (its x points left)": guess @ _turned(90.0),
        "the guess has the camera's position where the LiDAR's in the camera should be": position,
        "the guess has a transposed rotation": transposed,
        "the guess has a translation in millimetres": _in_millimetres(guess),
        "the guess is inverted, with its translation in millimetres": _in_millimetres(inverse),
        "the guess has a quaternion w x y z that was read as x y z w": _rotated(guess, y, z, w, x),
        "the guess has a quaternion x y z w that was read as w x y z": _rotated(guess, w, x, y, z),
    }


def _turned(degrees: float) -> Array:
    """(4, 4) a turn about z."""
    return transform(Rotation.from_euler("z", degrees, degrees=True))


def _in_millimetres(guess: Array) -> Array:
    metres = guess.copy()
    metres[:3, 3] /= 1000.0
    return metres


def _rotated(guess: Array, *xyzw: float) -> Array:
    """The guess with the rotation of a quaternion."""
    T = guess.copy()
    T[:3, :3] = Rotation.from_quat(xyzw).as_matrix()
    return T


def convention_error_between(guess: Array, result: Array) -> str | None:
    """The convention error of a guess that, undone, leads near the result; in words.

    Of errors that lead about as near, the first of the list, the most common one.
    """
    distances = {
        error: degrees / limit("convention_rotation") + metres / limit("convention_translation")
        for error, T in undo_convention_errors(guess).items()
        for degrees, metres in [_difference(T, result)]
        if degrees < limit("convention_rotation") and metres < limit("convention_translation")
    }
    least = min(distances.values(), default=0.0) + _AS_NEAR
    return next((error for error, distance in distances.items() if distance < least), None)


def likely_intended_guess(dataset: Dataset, guess: Rig) -> str | None:
    """The convention error of a guess that, undone, fits the images far better; a sentence.

    The guess is tried as it is, then with each error undone, as a search would try it: within some
    degrees and a metre.

    Returns:
        None if the cameras are near their guesses, if no corrected guess agrees with the images by
        far better than by chance, or if the images or clouds cannot be read.
    """
    frames = spread_out(dataset.frames, _FRAMES)
    try:
        with core_pool() as cores:
            seen = load_camera_frames(cache_of(frames, FrameCache()), frames, guess, cores)
            return _Trial(seen, guess).find()
    except (CalibrationError, OSError):
        return None


@dataclass(frozen=True, eq=False)
class _Trial:
    """Tries corrected guesses of some cameras of a rig."""

    frames: Mapping[str, CameraFrames]
    guess: Rig

    def find(self) -> str | None:
        """A sentence on the error that, undone, fits best the cameras that are lost with it."""
        some = list(self.guess.T_camera_lidar.items())[:_CAMERAS]
        given = {name: self._approach(name, T) for name, T in some}
        given = {n: one if _is_accepted(one) else self._refine(one) for n, one in given.items()}
        lost = {name: T for name, T in some if not _is_accepted(given[name])}
        starts = _corrected(lost)
        tried = [{name: self._approach(name, T) for name, T in each.items()} for each in starts]
        tried.sort(key=lambda each: -sum(candidate.z_score for candidate in each.values()))
        for each in tried[:_REFINED]:
            found = {name: self._refine(candidate) for name, candidate in each.items()}
            better = [one for name, one in found.items() if self._is_better(name, one, given[name])]
            if are_accepted([one.z_score for one in better], ALONE * len(starts)):
                best = max(better, key=lambda one: one.z_score)
                name = next(iter(best.body))
                error = convention_error_between(lost[name], best.body[name].T_camera_lidar)
                if error is None:
                    continue
                images = "the images" if len(lost) == len(some) else f"the images of {name}"
                return f"{images} fit clearly better if {error}"
        return None

    def _is_better(self, name: str, found: Candidate, given: Candidate) -> bool:
        """Whether a pose agrees better than the guess, which no search from there would reach."""
        gained = found.z_score >= limit("convention_gain") * given.z_score
        guess = self.guess.T_camera_lidar[name]
        return gained and not _in_reach(guess, found.body[name].T_camera_lidar)

    def _refine(self, candidate: Candidate) -> Candidate:
        """The candidate refined, if it is worth it."""
        hopeless = candidate.z_score < HOPELESS
        return candidate if hopeless else refine(self.frames, candidate.body)

    def _approach(self, name: str, T_camera_lidar: Array) -> Candidate:
        """The best pose within some degrees and a metre; z-score 0 if few points are in view."""
        camera = self.guess.cameras[name].moved_to(T_camera_lidar)
        points = self.frames[name].clouds[0].points_lidar_m
        pixels, valid = camera.lens.project(
            points @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
        )
        if np.sum(valid & camera.in_image(pixels)) < _LEAST_POINTS:
            return Candidate({name: camera}, 0.0)
        return approach(self.frames, {name: camera})


def _is_accepted(candidate: Candidate) -> bool:
    """Whether a single pose that was tried agrees by far better than by chance."""
    return candidate.z_score >= least_z_score(ALONE)


def _corrected(guess: Mapping[str, Array]) -> list[dict[str, Array]]:
    """The guesses with each convention error undone, without those that hardly differ."""
    by_camera = {name: undo_convention_errors(T) for name, T in guess.items()}
    errors = [*next(iter(by_camera.values()), ())]
    kept: list[dict[str, Array]] = []
    for error in errors:
        corrected = {name: each[error] for name, each in by_camera.items()}
        if not any(
            all(_is_near(T, other[name]) for name, T in corrected.items())
            for other in (guess, *kept)
        ):
            kept.append(corrected)
    return kept


def _is_near(one: Array, two: Array) -> bool:
    degrees, metres = _difference(one, two)
    return degrees < _NEAR_DEG and metres < _NEAR_M


def _in_reach(guess: Array, T_camera_lidar: Array) -> bool:
    """Whether the matcher's search from a guess reaches a pose."""
    degrees, metres = _difference(guess, T_camera_lidar)
    return degrees < math.sqrt(3) * SEARCH_DEG and metres < math.sqrt(3) * SEARCH_M


def _difference(one: Array, two: Array) -> tuple[float, float]:
    """Between two T_camera_lidar: angle [deg], difference of the translations [m]."""
    return angle_deg(one[:3, :3] @ two[:3, :3].T), float(np.linalg.norm(one[:3, 3] - two[:3, 3]))
