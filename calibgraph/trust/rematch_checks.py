"""Checks of a whole run: the rounds, the displaced start, and the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.run import MatchingRun, Rematch, RoundSummary
from calibgraph.model.geometry import pose_difference
from calibgraph.model.verdict import Check, above
from calibgraph.progress import Progress
from calibgraph.trust.guess import range_checks
from calibgraph.trust.image_checks import image_checks
from calibgraph.trust.solution_checks import (
    MOVING_FAIL_CM,
    MOVING_FAIL_DEG,
    MOVING_WARN_CM,
    MOVING_WARN_DEG,
)

Array = NDArray[np.float64]
Checks = Mapping[str, Sequence[Check]]

REMATCH_DEG, REMATCH_M = 0.5, 0.08
BACK_WARN_DEG, BACK_FAIL_DEG = 0.15, 0.5
BACK_WARN_CM, BACK_FAIL_CM = 5.0, 15.0
"""From where a matcher must find back to its result, and how near."""


def assess_images(
    run: MatchingRun, hashes: Mapping[str, str], progress: Progress
) -> dict[str, list[Check]]:
    """Per camera all checks that need images, clouds, or the matcher.

    Args:
        run: the outcome of the rounds.
        hashes: of the files, by path.
        progress: to be told how far it is.
    """
    rig, guess = run.solution.solved_rig, run.guess.T_camera_lidar
    repeated = frames_checks(run.dataset, hashes)
    again, seen = _asked_again(run, progress)
    return {
        name: [
            *last_round_checks(run.rounds, name),
            *range_checks(guess[name], T, run.correspondences.findings),
            *repeated,
            *again.get(name, ()),
            *seen.get(name, ()),
        ]
        for name, T in rig.T_camera_lidar.items()
    }


def _asked_again(run: MatchingRun, progress: Progress) -> tuple[Checks, Checks]:
    """What matching again says, and what the images say; in short, if there is no time for it."""
    again = rematch_checks(run.rematch)
    if not run.out_of_time:
        return again, image_checks_of(run, progress)
    missed = f"{run.missed_rounds} rounds of matching and " if run.missed_rounds else ""
    text = f"partial: there was no time for {missed}a second look at the images"
    check = Check("time limit", "WARN", text, run.missed_rounds)
    return {name: [*again.get(name, ()), check] for name in run.solution.solved_rig.cameras}, {}


def last_round_checks(rounds: Sequence[RoundSummary], camera: str) -> list[Check]:
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


def rematch_checks(rematch: Rematch | None) -> Checks:
    """Per camera, whether matching again from a displaced start ended at the same place."""
    if rematch is None:
        return {}
    if rematch.again is None:
        text = f"matching again from {_start()} gave nothing: {rematch.failure}"
        return {name: [Check("matching again", "FAIL", text)] for name in rematch.first.cameras}
    again = rematch.again.T_camera_lidar
    return {name: _apart(T, again[name]) for name, T in rematch.first.T_camera_lidar.items()}


def _start() -> str:
    return f"{REMATCH_DEG:g} deg, {100 * REMATCH_M:g} cm off"


def _apart(result: Array, again: Array) -> list[Check]:
    degrees, centimetres = pose_difference(result, again)
    name = f"matching again from {_start()} ends away by"
    advice = "the images do not pin it down"
    return [
        above(name, degrees, BACK_WARN_DEG, BACK_FAIL_DEG, "deg", advice),
        above(name, centimetres, BACK_WARN_CM, BACK_FAIL_CM, "cm", advice),
    ]


def image_checks_of(run: MatchingRun, progress: Progress) -> Checks:
    """What the images say of a result. Of another matcher's result they can only warn.

    They are asked by the matcher `structure`, which does not see everything that others see.
    """
    rig = run.solution.solved_rig
    try:
        seed = run.solution.config.seed
        checks = image_checks(run.dataset, rig, run.correspondences, seed=seed, progress=progress)
    except (CalibrationError, OSError) as error:  # what its matcher did not need to read
        text = f"the images could not be asked about the result: {error}"
        return {name: [Check("image evidence", "WARN", text)] for name in rig.cameras}
    if run.matcher.fails_on_images:
        return checks
    return {
        name: [replace(c, status="WARN") if c.status == "FAIL" else c for c in of_camera]
        for name, of_camera in checks.items()
    }
