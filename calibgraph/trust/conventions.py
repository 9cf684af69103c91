"""The common convention errors of a guess (direction, axes, units): each undone and compared."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations
from shlex import quote

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, RigError
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
from calibgraph.trust.thresholds import CONVENTION_DEG, CONVENTION_GAIN, CONVENTION_M

_FRAMES = 3  # that a corrected guess is matched in
_CAMERAS = 3  # of a rig, that they are tried for
_NEAR_DEG, _NEAR_M = 5.0, 0.5  # poses nearer than both are tried once
_AS_NEAR = 0.2  # of the limits of distance: as near, of rough guesses
_REFINED = 2  # of the corrected guesses
_LEAST_POINTS = 300  # of a cloud in the image, so that windows of it can agree
_AHEAD, _LEFT, _UP = np.eye(3)
_SIDES = {"ahead": _AHEAD, "behind": -_AHEAD, "left": _LEFT, "right": -_LEFT, "up": _UP,
          "down": -_UP}  # fmt: skip

WORDS: Mapping[str, str] = {
    "inverse": "the guess is inverted (it is T_lidar_camera)",
    "camera-flu": "the guess is of camera axes forward, left, up, not right, down, forward",
    "inverse-camera-flu": "the guess is inverted, and of camera axes forward, left, up",
    "camera-upside-down": "the camera is turned by 180 deg about its axis (upside down)",
    "camera-clockwise": "the camera is turned by 90 deg clockwise about its axis",
    "camera-counterclockwise": "the camera is turned by 90 deg counterclockwise about its axis",
    "position": "the guess has the camera's position where the LiDAR's in the camera should be",
    "transposed": "the guess has a transposed rotation",
    "millimetres": "the guess has a translation in millimetres",
    "inverse-millimetres": "the guess is inverted, with its translation in millimetres",
    "wxyz": "the guess has a quaternion w x y z that was read as x y z w",
    "xyzw": "the guess has a quaternion x y z w that was read as w x y z",
}
"""Convention errors by their names for ``--correct``, in words; those of the LiDAR's axes, which
are named by the sides to which x, y and z point as in ``cloud-right-down-ahead``, are not here."""


def undo_convention_errors(guess: Array) -> dict[str, Array]:
    """By name, the (4, 4) T_camera_lidar of a (4, 4) guess with each convention error undone.

    The names are those of ``WORDS`` and of the 23 other axes that a cloud may have. Common errors
    come first.
    """
    inverse, R, t = invert(guess), guess[:3, :3], guess[:3, 3]
    x, y, z, w = Rotation.from_matrix(R).as_quat()
    rolled = {degrees: transform(Rotation.from_euler("z", degrees, degrees=True))
              for degrees in (180.0, -90.0, 90.0)}  # fmt: skip
    return {
        "inverse": inverse,
        "camera-flu": T_OPTICAL_LINK @ guess,
        "inverse-camera-flu": T_OPTICAL_LINK @ inverse,
        **{name: guess @ transform(R) for name, R in _cloud_axes().items()},
        "camera-upside-down": rolled[180.0] @ guess,
        "camera-clockwise": rolled[-90.0] @ guess,
        "camera-counterclockwise": rolled[90.0] @ guess,
        "position": transform(R, -R @ t),
        "transposed": transform(R.T, t),
        "millimetres": transform(R, t / 1000.0),
        "inverse-millimetres": transform(inverse[:3, :3], inverse[:3, 3] / 1000.0),
        "wxyz": transform(Rotation.from_quat((y, z, w, x)), t),
        "xyzw": transform(Rotation.from_quat((w, x, y, z)), t),
    }


def in_words(error: str) -> str:
    """A convention error, as a clause after "if"."""
    if error in WORDS:
        return WORDS[error]
    x, y, z = error.split("-")[1:]
    if (x, y, z) == ("right", "down", "ahead"):
        return "the cloud is in optical axes (x right, y down, z ahead)"
    turn = Rotation.from_matrix(_cloud_axes()[error]).as_rotvec(degrees=True)
    about = [f"{abs(angle):.0f} deg about {axis}" for angle, axis in zip(turn, "xyz", strict=True)
             if abs(angle) > 1.0]  # fmt: skip
    turned = f"turned by {about[0]}" if len(about) == 1 else "others"
    return f"the LiDAR's axes are {turned} (its x points {x}, y {y}, z {z})"


def correct_guess(rig: Rig, errors: Iterable[str]) -> Rig:
    """A rig with convention errors of its guess undone.

    The errors are those of :func:`undo_convention_errors`, each for all cameras, or for one as
    CAMERA=NAME.

    Raises:
        RigError: if there is no such error, or no such camera.
    """
    known = undo_convention_errors(np.eye(4))
    for text in errors:
        camera, _, error = text.rpartition("=")
        if error not in known:
            raise RigError(f"no mistake {error!r} of a guess; known are {', '.join(known)}")
        names = [camera] if camera else [*rig.cameras]
        if names[0] not in rig.cameras:
            raise RigError(f"no camera {camera!r}; the rig has {', '.join(rig.cameras)}")
        undone = {n: undo_convention_errors(rig.cameras[n].T_camera_lidar)[error] for n in names}
        rig = rig.moved_to(undone)
    return rig


@cache
def _cloud_axes() -> dict[str, Array]:
    """By name, the (3, 3) rotations to x ahead, y left, z up from the other axes of a cloud.

    Those with z up first, then those of a single turn.
    """
    named = {
        f"cloud-{x}-{y}-{z}": np.column_stack([_SIDES[x], _SIDES[y], _SIDES[z]])
        for x, y, z in permutations(_SIDES, 3)
    }
    others = {n: R for n, R in named.items() if np.linalg.det(R) > 0 and (np.eye(3) != R).any()}
    return dict(sorted(others.items(), key=lambda item: (item[1][2, 2] < 1, np.trace(item[1]))))


def convention_error_between(
    guesses: Mapping[str, Array], results: Mapping[str, Array]
) -> str | None:
    """The error that, undone, leads near the results of all cameras, in the mean; its name.

    Of errors that lead about as near, the first of the list, the most common one.
    """
    distances: dict[str, float] = {}
    most_deg, most_m = CONVENTION_DEG, CONVENTION_M
    undone = {name: undo_convention_errors(guesses[name]) for name in results}
    for error in undo_convention_errors(np.eye(4)):
        apart = [difference(undone[name][error], T) for name, T in results.items()]
        if all(degrees < most_deg and metres < most_m for degrees, metres in apart):
            shares = (degrees / most_deg + metres / most_m for degrees, metres in apart)
            distances[error] = sum(shares) / len(apart)
    least = min(distances.values(), default=0.0) + _AS_NEAR
    return next((error for error, distance in distances.items() if distance < least), None)


def likely_intended_guess(dataset: Dataset, guess: Rig) -> str | None:
    """The mistake that, undone, makes guess and images agree far better, and how to undo it.

    The guess is tried as it is, then with each convention error undone, as a search would try it:
    within some degrees and a metre; then with mirrored images.

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
            better = {n: one for n, one in found.items() if self._is_better(n, one, given[n])}
            if are_accepted([one.z_score for one in better.values()], ALONE * len(starts)):
                poses = {name: one.body[name].T_camera_lidar for name, one in better.items()}
                error = convention_error_between(lost, poses)
                if error is not None:
                    return _sentence(error, [] if len(lost) == len(some) else [*better])
        return self._find_mirrored(lost, given)

    def _find_mirrored(
        self, lost: Mapping[str, Array], given: Mapping[str, Candidate]
    ) -> str | None:
        """The same of mirrored images; tangential distortion, which changes its sign, is kept."""
        frames, cameras = {}, {}
        for name in lost:
            seen, camera = self.frames[name], self.guess.cameras[name]
            frames[name] = replace(seen, grays=[gray.mirrored() for gray in seen.grays])
            k = camera.intrinsics_px
            k = k.model_copy(update={"cx": camera.width_px - 1 - k.cx})
            cameras[name] = camera.model_copy(update={"intrinsics_px": k})
        trial = _Trial(frames, self.guess.model_copy(update={"cameras": cameras}))
        found = {name: trial._refine(trial._approach(name, T)) for name, T in lost.items()}
        names = [n for n, one in found.items() if _is_accepted(one) and _gains(one, given[n])]
        text = (
            f"the images of {' and '.join(names)} are mirrored: record them unmirrored, or flip "
            "the files left to right"
        )
        return text if names else None

    def _is_better(self, name: str, found: Candidate, given: Candidate) -> bool:
        """Whether a pose agrees better than the guess, which no search from there would reach."""
        guess, T = self.guess.T_camera_lidar[name], found.body[name].T_camera_lidar
        degrees, metres = difference(guess, T)
        in_reach = degrees < math.sqrt(3) * SEARCH_DEG and metres < math.sqrt(3) * SEARCH_M
        return _gains(found, given) and not in_reach

    def _refine(self, candidate: Candidate) -> Candidate:
        """The candidate refined, if it is worth it."""
        hopeless = candidate.z_score < HOPELESS
        return candidate if hopeless else refine(self.frames, candidate.body)

    def _approach(self, name: str, T_camera_lidar: Array) -> Candidate:
        """The best pose within some degrees and a metre; z-score 0 if few points are in view."""
        camera = self.guess.cameras[name].moved_to(T_camera_lidar)
        points = self.frames[name].clouds[0].points_lidar_m
        pixels, valid = camera.lens.project(points, T_camera_lidar)
        if np.sum(valid & camera.in_image(pixels)) < _LEAST_POINTS:
            return Candidate({name: camera}, 0.0)
        return approach(self.frames, {name: camera})


def _sentence(error: str, cameras: Sequence[str]) -> str:
    """What is wrong with the guess of some cameras, of all if none is named; and what undoes it."""
    named = [quote(f"{name}={error}") for name in cameras] or [error]
    options = " ".join(f"--correct {each}" for each in named)
    images = f"the images of {' and '.join(cameras)}" if cameras else "the images"
    return (
        f"{images} fit clearly better if {in_words(error)}; undo it with "
        f"calibgraph rig RIG {options} --out FILE.yaml"
    )


def _gains(found: Candidate, given: Candidate) -> bool:
    return found.z_score >= CONVENTION_GAIN * given.z_score


def _is_accepted(candidate: Candidate) -> bool:
    """Whether a single pose that was tried agrees by far better than by chance."""
    return candidate.z_score >= least_z_score(ALONE)


def _corrected(guess: Mapping[str, Array]) -> list[dict[str, Array]]:
    """The guesses with each convention error undone, without those that hardly differ."""
    by_camera = {name: undo_convention_errors(T) for name, T in guess.items()}
    kept: list[dict[str, Array]] = []
    for error in next(iter(by_camera.values()), ()):
        corrected = {name: each[error] for name, each in by_camera.items()}
        apart = (
            [difference(T, other[name]) for name, T in corrected.items()]
            for other in (guess, *kept)
        )
        if not any(all(deg < _NEAR_DEG and m < _NEAR_M for deg, m in each) for each in apart):
            kept.append(corrected)
    return kept


def difference(one: Array, two: Array) -> tuple[float, float]:
    """Between two T_camera_lidar: angle [deg], difference of the translations [m]."""
    return angle_deg(one[:3, :3] @ two[:3, :3].T), float(np.linalg.norm(one[:3, 3] - two[:3, 3]))
