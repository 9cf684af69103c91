"""Can the result be used? All checks, in the order in which they are reported.

To add a check: a function from the evidence to checks with their cameras, in the file of its
subject; its name in one of the tuples below; and a row in ``trust.thresholds`` if it compares a
number with limits. In ``solution_checks.check_estimate`` it is made while driving, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from calibgraph.matching.run import MatchingRun
from calibgraph.model.verdict import ABOUT_THE_DATA, BRIGHTNESS, Check
from calibgraph.trust import (
    agreement,
    corrected,
    guess,
    image_evidence,
    lens_checks,
    matcher_checks,
    solution_checks,
)
from calibgraph.trust.conventions import likely_intended_guess
from calibgraph.trust.evidence import Checks, Evidence, Found, by_camera
from calibgraph.trust.image_record import to_metadata
from calibgraph.trust.inputs import describe_brightness

_LOOKED_AT = 6  # frames whose brightness is measured

SOLUTION_CHECKS: tuple[Callable[[Evidence], Found], ...] = (
    guess.guess_checks,                    # does a convention error explain how far it is?
    guess.swap_checks,                     # are the images of two cameras swapped?
    guess.point_distance_checks,           # are the points in metres?
    solution_checks.flat_evidence_checks,  # do the images leave the pose more open?
    solution_checks.estimate_checks,       # residuals, sigmas, relative poses, counts, convergence
    agreement.pair_agreement_checks,       # do two cameras' images agree with the matches?
    agreement.one_pose_checks,             # have two cameras one device's images?
    matcher_checks.matcher_checks,         # findings of the matcher: search, failed frames, z-score
    agreement.competing_solution_checks,   # do the left-out matches agree on another extrinsic?
    solution_checks.outlier_frame_checks,  # how many frames were left out?
    agreement.place_checks,                # does a place contradict the others?
    solution_checks.repeated_frame_checks, # how many are of one place, or copies?
    lens_checks.intrinsics_checks,         # would another lens explain the residuals?
    lens_checks.offset_checks,             # would images of another time?
)  # fmt: skip
"""Checks of a solution, from correspondences alone; those that name a cause come first."""

RUN_CHECKS: tuple[Callable[[MatchingRun], Found], ...] = (
    matcher_checks.last_round_checks,      # have the rounds of matching converged?
    matcher_checks.repeated_file_checks,   # are the frames independent?
    matcher_checks.compare_ends,           # does matching from a displaced start end here?
    matcher_checks.going_on_checks,        # did the rounds end elsewhere first?
    matcher_checks.time_limit_checks,      # was anything left out for lack of time?
    corrected.corrected_checks,            # are clouds corrected for motion twice?
    image_evidence.image_checks,           # do the images agree with the result?
    lens_checks.image_offset_checks,       # would they agree better at another time?
)  # fmt: skip
"""Checks of a run, which also need the matcher, the images or the clouds."""


def assess(evidence: Evidence) -> dict[str, list[Check]]:
    """Per camera, the checks of a solution."""
    return by_camera(evidence.cameras, *(check(evidence) for check in SOLUTION_CHECKS))


def assess_run(run: MatchingRun, evidence: Evidence) -> tuple[Checks, dict[str, Any]]:
    """The checks of a run and of its solution; a likely cause of a failure comes first.

    And what the images showed, as a key of the table's metadata.
    """
    cameras, of_solution = evidence.cameras, assess(evidence)
    of_run = by_camera(cameras, *(check(run) for check in RUN_CHECKS))
    both = {name: of_solution[name] + of_run[name] for name in cameras}
    causes = by_camera(cameras, _brightness_checks(run, both), _intended_guess_checks(run, both))
    record = to_metadata(evidence, causes, of_run)
    return {name: causes[name] + both[name] for name in cameras}, record


def _brightness_checks(run: MatchingRun, checks: Checks) -> Found:
    """Images too dark or bright to show structure, at cameras with which something is wrong."""
    data = run.dataset.spread_out(_LOOKED_AT)
    for name, of_camera in checks.items():
        wrong = [c for c in of_camera if c.status != "PASS" and c.kind not in ABOUT_THE_DATA]
        camera = run.guess.cameras[name]
        grays = [frame.load_gray(name, camera).mean() for frame in data.frames if wrong]
        if wrong and (text := describe_brightness(name, grays)):
            decisive = any(check.decisive for check in wrong)  # the cause of one is one
            yield name, Check(BRIGHTNESS, "FAIL" if decisive else "WARN", text)


def _intended_guess_checks(run: MatchingRun, checks: Checks) -> Found:
    """Whether a convention error in the guess explains the failure of cameras.

    It takes seconds, so that a time limit that has passed does not prevent it.
    """
    failed = [n for n, each in checks.items() if any(check.status == "FAIL" for check in each)]
    error = likely_intended_guess(run.dataset, run.guess) if failed else None
    for name in failed if error else ():
        yield name, Check("convention of the guess", "FAIL", error or "")
