"""What only images can tell of a result, and what a hopeless guess may have meant."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.check import Check, above
from calibgraph.conventions import range_checks, reread
from calibgraph.correspondences import Correspondences, concatenate
from calibgraph.dataset import Dataset
from calibgraph.errors import CalibrationError, CorrespondenceError
from calibgraph.perturbation import perturb
from calibgraph.problem import Clock, Fit
from calibgraph.progress import Progress, silent
from calibgraph.rig import Rig, angle_deg, distance
from calibgraph.two_pass import fit
from calibgraph.verdict import (
    CONTRAST_FAIL,
    MOVING_FAIL_CM,
    MOVING_FAIL_DEG,
    MOVING_WARN_CM,
    MOVING_WARN_DEG,
)

if TYPE_CHECKING:
    from calibgraph.pipeline import Matcher

Array = NDArray[np.float64]
Checks = Mapping[str, Sequence[Check]]

BACK_DEG, BACK_M = 0.5, 0.08
BACK_WARN_DEG, BACK_FAIL_DEG = 0.15, 0.5
BACK_WARN_CM, BACK_FAIL_CM = 5.0, 15.0
"""From where a matcher must find back to its result, and how near."""

BETTER = 1.03
"""Times the contrast of a result. On KITTI, ends 8 to 12 cm off had 8 to 16 % less contrast than
those at 3 cm; ends at the same place differ by some percent, and are as good."""

_READING_FRAMES = 2
_CLEARER = 1.3  # times the contrast of the guess as it is


@dataclass(frozen=True, eq=False)
class Ends:
    """Where matching ended from two starts, the second displaced from the end of the first.

    Attributes:
        first: the end of the rounds.
        again: the end of matching again; None if it gave nothing.
        why_none: why it gave nothing.
    """

    first: Rig
    again: Rig | None
    why_none: str = ""


@dataclass(frozen=True, eq=False)
class Matched:
    """What matching in rounds gave.

    Attributes:
        dataset: images and clouds.
        matcher: what found the correspondences.
        guess: where the first round started.
        table: the correspondences of the last round; of cameras that were taken from matching
            again, those.
        fit: the solution from them.
        rounds: per round and camera, how many matches, and how far they moved it.
        clock: what took how long.
        missed_rounds: how many rounds there was no time for.
        out_of_time: whether the time limit has passed.
        ends: of matching again; None if it was not.
    """

    dataset: Dataset
    matcher: Matcher
    guess: Rig
    table: Correspondences
    fit: Fit
    rounds: tuple[dict[str, Any], ...]
    clock: Clock
    missed_rounds: int = 0
    out_of_time: bool = False
    ends: Ends | None = None


def matched_again(matched: Matched, progress: Progress, out_of_time: Callable[[], bool]) -> Matched:
    """Match again from a start displaced from the result, if the matcher names rounds for it.

    Where an objective is flat, as along the axis of a camera in a straight street, rounds may stand
    still before its top. Cameras in whose images the second end has a clearly higher contrast are
    taken from there; not if the ends are so far apart that the camera fails.
    """
    rounds = getattr(matched.matcher, "tracking_rounds", ())
    if not rounds or not matched.fit.problem.fits_matches:
        return matched
    first = matched.fit.solved_rig
    try:
        again = _again(matched, (*rounds, matched.matcher.rounds - 1), progress, out_of_time)
        if again is None:
            return matched
        matched = replace(matched, ends=Ends(first, again.fit.solved_rig))
        better = _better(matched, again)
        return _with_cameras_of(matched, again, better) if better else matched
    except CorrespondenceError as error:
        return replace(matched, ends=Ends(first, None, str(error)))


@dataclass(frozen=True, eq=False)
class _Again:
    """The last round of matching again: its table, the solution from it, how far it moved."""

    table: Correspondences
    fit: Fit
    moved: dict[str, Any]


def _again(
    matched: Matched, rounds: Sequence[int], progress: Progress, out_of_time: Callable[[], bool]
) -> _Again | None:
    """Go through the rounds from a displaced start; None if the time is over before their end."""
    config, terms = matched.fit.config, matched.fit.problem.terms
    rig = matched.fit.solved_rig
    estimate = perturb(rig, rotation_deg=BACK_DEG, translation_m=BACK_M, seed=config.seed)
    found = None
    for index in dict.fromkeys(rounds):
        if out_of_time():
            return None
        table = matched.matcher.match(
            matched.dataset,
            estimate,
            round_index=index,
            progress=lambda what, done, total: progress("matching again", done, total),
        )
        again = fit(estimate, table, config, terms)
        found = _Again(table, again, round_of(table, estimate, again.solved_rig))
        estimate = again.solved_rig
    return found


def _better(matched: Matched, again: _Again) -> set[str]:
    """The cameras in whose images the second end stands out more, and is not far from the first."""
    before, now = (t.metadata.get("contrast", {}) for t in (matched.table, again.table))
    near = {
        name
        for name, checks in return_checks(matched.ends).items()
        if all(check.status != "FAIL" for check in checks)
    }
    return {n for n in near if now.get(n, -np.inf) > BETTER * before.get(n, np.inf)}


def _with_cameras_of(matched: Matched, again: _Again, better: set[str]) -> Matched:
    """The result with some cameras' matches, starts and last rounds of the second end."""
    parts = [
        (again.table if name in better else matched.table).of_camera(name)
        for name in matched.guess.cameras
    ]
    before, now = (t.metadata["contrast"] for t in (matched.table, again.table))
    contrast = {**before, **{name: now[name] for name in better}}
    mixed = replace(concatenate(parts), metadata={**matched.table.metadata, "contrast": contrast})
    start = matched.fit.rig.moved_to({n: again.fit.rig.T_camera_lidar[n] for n in better})
    last = {**matched.rounds[-1], **{name: again.moved[name] for name in better}}
    return replace(
        matched,
        table=mixed,
        fit=fit(start, mixed, matched.fit.config, matched.fit.problem.terms),
        rounds=(*matched.rounds[:-1], last),
    )


def round_of(table: Correspondences, before: Rig, after: Rig) -> dict[str, Any]:
    """What one round found, and how far it moved each camera."""
    counts = table.counts()
    cameras = {}
    for name, old in before.T_camera_lidar.items():
        delta = after.T_camera_lidar[name] @ np.linalg.inv(old)
        cameras[name] = {
            "matches": counts.get(name, 0),
            "moved_deg": angle_deg(delta[:3, :3]),
            "moved_cm": 100.0 * float(np.linalg.norm(delta[:3, 3])),
        }
    return cameras


def second_look(
    matched: Matched, hashes: Mapping[str, str], progress: Progress
) -> dict[str, list[Check]]:
    """Per camera all checks that need images, clouds, or the matcher.

    Args:
        matched: what matching gave.
        hashes: of the files, by path.
        progress: to be told how far it is.
    """
    rig, guess = matched.fit.solved_rig, matched.guess.T_camera_lidar
    repeated = frames_checks(matched.dataset, hashes)
    again, seen = _asked_again(matched, progress)
    return {
        name: [
            *last_round_checks(matched.rounds, name),
            *range_checks(guess[name], T, matched.table.metadata),
            *repeated,
            *again.get(name, ()),
            *seen.get(name, ()),
        ]
        for name, T in rig.T_camera_lidar.items()
    }


def _asked_again(matched: Matched, progress: Progress) -> tuple[Checks, Checks]:
    """What matching again says, and what the images say; in short, if there is no time for it."""
    again = return_checks(matched.ends)
    if not matched.out_of_time:
        return again, image_checks_of(matched, progress)
    missed = f"{matched.missed_rounds} rounds of matching and " if matched.missed_rounds else ""
    text = f"partial: there was no time for {missed}a second look at the images"
    check = Check("time limit", "WARN", text, matched.missed_rounds)
    return {name: [*again.get(name, ()), check] for name in matched.fit.solved_rig.cameras}, {}


def last_round_checks(rounds: Sequence[dict[str, Any]], camera: str) -> list[Check]:
    """Whether the last of several rounds of matching still moved a camera."""
    if len(rounds) == 1:
        return []
    last, what = rounds[-1][camera], "the last round of matching moved it by"
    return [
        above(what, last["moved_deg"], MOVING_WARN_DEG, MOVING_FAIL_DEG, "deg"),
        above(what, last["moved_cm"], MOVING_WARN_CM, MOVING_FAIL_CM, "cm"),
    ]


def frames_checks(dataset: Dataset, hashes: Mapping[str, str]) -> list[Check]:
    """Whether two frames have the very same cloud: they are no independent evidence."""
    seen: dict[str, str] = {}
    for frame in dataset.frames:
        digest = hashes[str(frame.cloud_path)]
        if digest in seen:
            text = f"frames {seen[digest]} and {frame.name} have the same cloud: counted as if "
            return [Check("repeated frames", "WARN", text + "independent; remove one")]
        seen[digest] = frame.name
    return []


def return_checks(ends: Ends | None) -> Checks:
    """Per camera, whether matching again from a displaced start ended at the same place."""
    if ends is None:
        return {}
    if ends.again is None:
        text = f"matching again from {_start()} gave nothing: {ends.why_none}"
        return {name: [Check("matching again", "FAIL", text)] for name in ends.first.cameras}
    again = ends.again.T_camera_lidar
    return {name: _apart(T, again[name]) for name, T in ends.first.T_camera_lidar.items()}


def _start() -> str:
    return f"{BACK_DEG:g} deg, {100 * BACK_M:g} cm off"


def _apart(result: Array, again: Array) -> list[Check]:
    degrees, centimetres = distance(result, again)
    name = f"matching again from {_start()} ends away by"
    advice = "the images do not pin it down"
    return [
        above(name, degrees, BACK_WARN_DEG, BACK_FAIL_DEG, "deg", advice),
        above(name, centimetres, BACK_WARN_CM, BACK_FAIL_CM, "cm", advice),
    ]


def image_checks_of(matched: Matched, progress: Progress) -> Checks:
    """What the images say of a result. Of another matcher's result they can only warn.

    They are asked by the matcher `structure`, which does not see everything that others see.
    """
    from calibgraph.image_checks import image_checks
    from calibgraph.structure import StructureMatcher

    rig = matched.fit.solved_rig
    try:
        seed = matched.fit.config.seed
        checks = image_checks(matched.dataset, rig, matched.table, seed=seed, progress=progress)
    except (CalibrationError, OSError) as error:  # what its matcher did not need to read
        text = f"the images could not be asked about the result: {error}"
        return {name: [Check("image evidence", "WARN", text)] for name in rig.cameras}
    if isinstance(matched.matcher, StructureMatcher):
        return checks
    return {
        name: [replace(c, status="WARN") if c.status == "FAIL" else c for c in of_camera]
        for name, of_camera in checks.items()
    }


def better_reading(dataset: Dataset, guess: Rig) -> str | None:
    """How a guess that led nowhere may have been meant, by what fits the images; in words.

    Every reading is matched once by the matcher `structure`, coarsely, in a few frames. None if
    no reading is clearly better, or if the images, which another matcher may not need, cannot be
    read.
    """
    from calibgraph.structure import StructureMatcher

    matcher = StructureMatcher()
    few = dataset.spread_out(_READING_FRAMES)
    try:
        least = max(CONTRAST_FAIL, _CLEARER * _contrast(few, matcher, guess))
        contrasts = {words: _contrast(few, matcher, rig) for words, rig in reread(guess).items()}
    except (CalibrationError, OSError):
        return None
    best = max(contrasts, key=lambda words: contrasts[words], default=None)
    return best if best is not None and contrasts[best] > least else None


def _contrast(dataset: Dataset, matcher: Matcher, rig: Rig) -> float:
    """The mean contrast over the cameras; 0 where nothing can be matched."""
    table = matcher.match(dataset, rig, round_index=0, progress=silent)
    found: Mapping[str, float] = table.metadata.get("contrast", {})
    return float(np.mean([found.get(name, 0.0) for name in rig.cameras]))
