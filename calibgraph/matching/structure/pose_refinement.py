"""Pose refinement: improve a pose of the global search, level by level."""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cache, partial

from calibgraph.io.frame import Frame
from calibgraph.matching.structure.bodies import Body, adjoint, lead, place
from calibgraph.matching.structure.consensus import (
    displaced_z_score,
    find_consensus,
    score_displaced,
)
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.prepared_image import PreparedImage
from calibgraph.matching.structure.schedule import LEVELS, WIDE, Level
from calibgraph.matching.structure.shift_scores import (
    ShiftScores,
    concatenate_scores,
    pad_grids,
    score_frame,
)
from calibgraph.solver.columns import apply_twist

APPROACH = (WIDE, 4_000)
REFINEMENT = (
    (replace(LEVELS[0], translation_m=0.5), 6_000),
    (replace(LEVELS[1], translation_m=0.5), 20_000),
    (replace(LEVELS[2], translation_m=0.3), 20_000),
)
"""Levels, and their windows per camera over all frames. They reach farther than the rounds: a
search is accurate to about a degree and some decimetres."""

HOPELESS = 8.0
"""Below this z-score at its first level a refinement is given up. On KITTI, `surround6` and
rendered streets right poses had 14 and more there, and all that led to 10.6 at the last level 11.
"""

CONFIDENT, STANDING_OUT = 20.0, 4.2
"""From this z-score on, and this one beside displaced poses, no better pose is looked for. On KITTI
05 and 07, poses 0.8 to 4.6 degrees or 30 to 160 cm off had z-scores of 10.8 to 19.4. With frames of
one place z-scores are larger: in a laboratory, poses 3 to 7 degrees off had 20 to 32, and 2.2 to
4.1 beside displaced ones, the right one 72 and 5.0. Right ones on KITTI have 4.2 to 6.8 there."""
DISPLACED = (LEVELS[1], 10_000)

SECOND_LOOK = ((LEVELS[3], 20_000), (LEVELS[4], 30_000))
"""Fine levels, with weighed windows: these have not been maximized over by the search."""

GAIN = 1.05  # by which the z-score must grow for another refinement
MAX_REFINEMENTS = 4


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """The data of one camera in a few frames."""

    frames: Sequence[Frame]
    grays: Sequence[PreparedImage]
    clouds: Sequence[PreparedCloud]
    cores: Executor


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate pose of a body.

    Attributes:
        body: at that pose.
        z_score: of the last level of a refinement.
        stands_out: returns whether displaced poses agree far less; scored when it is asked for.
        chance: the probability that a search with nothing to find ends as high; None if unknown.
    """

    body: Body
    z_score: float
    stands_out: Callable[[], bool] = lambda: False
    chance: float | None = None

    @property
    def is_beyond_doubt(self) -> bool:
        """Whether no better pose has to be looked for."""
        return self.z_score >= CONFIDENT and self.stands_out()


def approach(frames: Mapping[str, CameraFrames], body: Body) -> Candidate:
    """Improve a pose that may be off by some degrees and a metre."""
    return _improve(frames, body, *APPROACH)


def refine(frames: Mapping[str, CameraFrames], body: Body) -> Candidate:
    """Improve a pose that may be off by about two degrees and half a metre.

    The candidate has the z-score of the last level, so that different poses can be compared;
    a hopeless pose has the z-score of the first level.
    """
    for level, windows in REFINEMENT:
        candidate = _improve(frames, body, level, windows)
        body = candidate.body
        if candidate.z_score < HOPELESS:
            break
    return replace(candidate, stands_out=cache(partial(_stands_out, frames, body)))


def look_again(frames: Mapping[str, CameraFrames], body: Body) -> Candidate:
    """The body refined at fine levels, with the z-score of the last one."""
    candidate = Candidate(body, -math.inf)
    for level, windows in SECOND_LOOK:
        candidate = _improve(frames, candidate.body, level, windows)
    return candidate


def refine_on(frames: Mapping[str, CameraFrames], candidate: Candidate) -> Candidate:
    """Refine a candidate further, as long as its z-score grows."""
    for _ in range(MAX_REFINEMENTS):
        again = refine(frames, candidate.body)
        if again.z_score < GAIN * candidate.z_score:
            break
        candidate = again
    return candidate


def _improve(
    frames: Mapping[str, CameraFrames], body: Body, level: Level, windows: int
) -> Candidate:
    """The best pose within the reach of a level."""
    twist, z_score = find_consensus(_score_body(frames, body, level, windows), level, seed=0)
    return Candidate(place(body, apply_twist(lead(body), twist).T_camera_lidar), z_score)


def _stands_out(frames: Mapping[str, CameraFrames], body: Body) -> bool:
    _, per_frame = score_displaced(_score_body(frames, body, *DISPLACED))
    return displaced_z_score(per_frame) >= STANDING_OUT


def _score_body(
    frames: Mapping[str, CameraFrames], body: Body, level: Level, windows: int
) -> ShiftScores:
    """The scores of all cameras, by twists of the body's lead."""
    scores = [_score_camera(frames[name], body, name, level, windows=windows) for name in body]
    return concatenate_scores(pad_grids(scores))


def _score_camera(
    frames: CameraFrames, body: Body, name: str, level: Level, *, windows: int
) -> ShiftScores:
    """The scores of a camera in all its frames, by twists of the body's lead."""

    def score(number: int) -> ShiftScores:
        gray, cloud = frames.grays[number], frames.clouds[number]
        twist = frames.frames[number].twist_per_s
        return score_frame(
            gray, cloud, body[name], level, frame=number, max_windows=most, twist_per_s=twist
        )

    most, numbers = windows // len(frames.grays), range(len(frames.grays))
    scores = concatenate_scores(list(frames.cores.map(score, numbers)))
    if body[name] is lead(body):
        return scores
    return replace(scores, jacobian=scores.jacobian @ adjoint(body, name))
