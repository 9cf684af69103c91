"""Pose refinement: improve a candidate pose of the global search, then accept or reject it."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.structure.consensus import find_consensus
from calibgraph.matching.structure.epipolar import Features, detect_features
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.schedule import LEVELS, Level
from calibgraph.matching.structure.shift_scores import (
    ShiftScores,
    concatenate_scores,
    score_frame,
)
from calibgraph.model.geometry import angle_deg, relative_transform
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import apply_twist

ACCEPTED = 16.0
"""Least z-score after the last of the levels. On recorded scenes within 20 deg and 1.5 m of the
guess, wrong poses had up to 15, right ones mostly from 17 on."""

ACCEPTED_NEAR = ((12.0, 1 / 1.3), (11.0, 1.0), (8.0, 1.3))
"""Least z-score of the pose refined from the guess, and its least ratio to the best z-score found
elsewhere: one of these pairs must be reached. It is unlikely that of all poses tried the guess is
the one that agrees best by chance. Applied only after a search: guesses 1.5 to 3 deg off have been
refined to poses 30 to 50 cm off with 12.3, where the right poses had 19."""

ABANDONED = 7.5  # z-score after any level, below which to stop: no right pose had less than 11
REPEATED, GAIN = 11.0, 1.05  # z-score from which to refine again, and by how much it must grow
REFINEMENT = (
    (replace(LEVELS[0], translation_m=0.5), 6_000),
    (replace(LEVELS[1], translation_m=0.5), 20_000),
    (replace(LEVELS[2], translation_m=0.3), 20_000),
)
"""Levels, and their windows per camera over all frames. They reach farther than the rounds: a
search is accurate to about a degree and some decimetres."""

SAME_DEG, SAME_M = 0.5, 0.15  # candidates nearer than this are the same pose


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """The data of one camera in a few frames.

    Attributes:
        grays: (height, width) images.
        clouds: one per image.
        cores: a thread per core, which works on several frames in parallel.
    """

    grays: Sequence[NDArray[np.uint8]]
    clouds: Sequence[PreparedCloud]
    cores: Executor

    @cached_property
    def features(self) -> list[Features]:
        """The features of each image."""
        return list(self.cores.map(detect_features, self.grays))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate pose of a camera.

    Attributes:
        camera: at the pose.
        z_score: agreement of image and cloud there, in standard deviations of chance agreement.
        accepted: whether that is high enough.
    """

    camera: Camera
    z_score: float
    accepted: bool


def refine(frames: CameraFrames, camera: Camera) -> Candidate:
    """Refine a camera's pose until it is accepted or its z-score grows no more."""
    candidate = _refine_once(frames, camera)
    while REPEATED <= candidate.z_score < ACCEPTED:
        again = _refine_once(frames, candidate.camera)
        if again.z_score < GAIN * candidate.z_score:
            break
        candidate = again
    return candidate


def select_candidate(near: Candidate, far: Candidate | None, *, after_search: bool) -> Candidate:
    """Select between the pose refined from the guess and the best one found elsewhere.

    Args:
        near: refined from the guess.
        far: the best of all proposals and searches; None if there was none.
        after_search: whether a search has been tried, so that ``ACCEPTED_NEAR`` applies.
    """
    if far is None or near.accepted:
        return near
    best = max(near, far, key=lambda candidate: candidate.z_score)
    mine, rival = (best, 0.0) if _is_same_pose(near, far) else (near, far.z_score)
    if any(mine.z_score >= max(least, ratio * rival) for least, ratio in ACCEPTED_NEAR):
        return replace(mine, accepted=mine.accepted or after_search)
    return best


def _refine_once(frames: CameraFrames, camera: Camera) -> Candidate:
    """Go through the levels once, or until the z-score is too low to go on."""
    z_score = 0.0
    for level, windows in REFINEMENT:
        score = partial(_score, camera, level, windows // len(frames.grays))
        numbers = range(len(frames.grays))
        per_frame = frames.cores.map(score, frames.grays, frames.clouds, numbers)
        twist, z_score = find_consensus(concatenate_scores(list(per_frame)), level, seed=0)
        camera = apply_twist(camera, twist)
        if z_score < ABANDONED:
            break
    return Candidate(camera, z_score, z_score >= ACCEPTED)


def _score(
    camera: Camera,
    level: Level,
    max_windows: int,
    gray: NDArray[np.uint8],
    cloud: PreparedCloud,
    number: int,
) -> ShiftScores:
    return score_frame(gray, cloud, camera, level, frame=number, max_windows=max_windows)


def _is_same_pose(one: Candidate, two: Candidate) -> bool:
    step = relative_transform(one.camera.T_camera_lidar, two.camera.T_camera_lidar)
    return angle_deg(step[:3, :3]) < SAME_DEG and float(np.linalg.norm(step[:3, 3])) < SAME_M
