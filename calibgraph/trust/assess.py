"""Can the result be used? All checks, in the order in which they are reported.

To add a check: a function from the evidence to checks per camera, in the file of its subject; its
name in one of the tuples below; and a row in ``trust.thresholds`` if it compares a number with
limits. In ``solution_checks.check_estimate`` it is made while driving, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from calibgraph.matching.run import MatchingRun
from calibgraph.model.verdict import ABOUT_THE_DATA, BRIGHTNESS, Check
from calibgraph.trust import (
    agreement,
    guess,
    image_evidence,
    lens_checks,
    matcher_checks,
    solution_checks,
)
from calibgraph.trust.conventions import likely_intended_guess
from calibgraph.trust.evidence import Checks, Evidence, concatenate
from calibgraph.trust.image_record import RunChecks
from calibgraph.trust.inputs import describe_brightness
from calibgraph.trust.lens_parameter import advise_together

_LOOKED_AT = 6  # frames whose brightness is measured

SOLUTION_CHECKS: tuple[Callable[[Evidence], Checks], ...] = (
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

RUN_CHECKS: tuple[Callable[[MatchingRun], Checks], ...] = (
    matcher_checks.last_round_checks,      # have the rounds of matching converged?
    matcher_checks.repeated_file_checks,   # are the frames independent?
    matcher_checks.compare_ends,           # does matching from a displaced start end here?
    matcher_checks.going_on_checks,        # did the rounds end elsewhere first?
    matcher_checks.time_limit_checks,      # was anything left out for lack of time?
    image_evidence.image_checks,           # do the images agree with the result?
    lens_checks.image_offset_checks,       # would they agree better at another time?
)  # fmt: skip
"""Checks of a run, which also need the matcher, the images or the clouds."""


def assess(evidence: Evidence) -> dict[str, list[Check]]:
    """Per camera, the checks of a solution."""
    return concatenate([check(evidence) for check in SOLUTION_CHECKS], evidence.cameras)


def assess_run(run: MatchingRun, evidence: Evidence) -> RunChecks:
    """The checks of a run and of its solution; if it failed, with the likely cause."""
    of_solution = assess(evidence)
    of_run = concatenate([check(run) for check in RUN_CHECKS], evidence.cameras)
    checks = concatenate([of_solution, of_run], evidence.cameras)
    causes = (
        _brightness_checks(run, checks),
        _intended_guess_checks(run, checks),
    )
    return RunChecks(of_solution, of_run, concatenate(causes, evidence.cameras))


def in_order(checks: RunChecks, cameras: Sequence[str]) -> dict[str, list[Check]]:
    """Per camera, all checks; the likely cause of a failure comes first."""
    joined = concatenate([checks.causes, checks.of_solution, checks.of_run], cameras)
    return {name: advise_together(each) for name, each in joined.items()}


def _brightness_checks(run: MatchingRun, checks: Checks) -> Checks:
    """Images too dark or bright to show structure, at cameras with which something is wrong."""
    found: dict[str, list[Check]] = {}
    data = run.dataset.spread_out(_LOOKED_AT)
    for name, of_camera in checks.items():
        wrong = [c for c in of_camera if c.status != "PASS" and c.kind not in ABOUT_THE_DATA]
        camera = run.guess.cameras[name]
        grays = [frame.load_gray(name, camera).mean() for frame in data.frames if wrong]
        if wrong and (text := describe_brightness(name, grays)):
            decisive = any(check.decisive for check in wrong)  # the cause of one is one
            found[name] = [Check(BRIGHTNESS, "FAIL" if decisive else "WARN", text)]
    return found


def _intended_guess_checks(run: MatchingRun, checks: Checks) -> Checks:
    """Whether a convention error in the guess explains the failure of cameras.

    It takes seconds, so that a time limit that has passed does not prevent it.
    """
    failed = [n for n, each in checks.items() if any(check.status == "FAIL" for check in each)]
    error = likely_intended_guess(run.dataset, run.guess) if failed else None
    found = [] if error is None else [Check("convention of the guess", "FAIL", error)]
    return dict.fromkeys(failed, found)
