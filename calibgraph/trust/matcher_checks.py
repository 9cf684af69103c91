"""Checks of the matcher's findings."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from calibgraph.matching.structure.acceptance import FEW_FRAMES, SEARCH, probability_by_chance
from calibgraph.matching.structure.global_search import ALONE
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.threshold import Threshold
from calibgraph.model.verdict import FAIL_ABOVE, TOLERANCE, Check
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.solution_checks import check_sigmas
from calibgraph.trust.thresholds import threshold

_OF_FEW_FRAMES = replace(SEARCH, sigma=0.0)  # in which the search has measured the location


def matcher_checks(evidence: Evidence) -> Checks:
    """The checks of every camera's matches.

    The error that all frames share is part of the error bar, with which it is checked; where there
    is no error bar it is checked alone.
    """
    findings = _with_chance_of_few_frames(evidence)
    shared_sigmas = findings.systematic_sigmas if evidence.joint_covariance is None else None
    tolerance = evidence.solution.config.tolerance
    return {
        name: check_findings(findings, name, shared_sigmas, tolerance) for name in evidence.cameras
    }


def _with_chance_of_few_frames(evidence: Evidence) -> MatcherFindings:
    """The findings without what is found by chance in more frames, where no search measures it."""
    table, findings = evidence.solution.correspondences, evidence.findings
    few = {
        name: chance
        for name, chance in findings.chance.items()
        if len(np.unique(table.of_camera(name).frame)) <= FEW_FRAMES
    }
    return replace(findings, chance=few)


def check_findings(
    findings: MatcherFindings,
    camera: str,
    shared_sigmas: tuple[float, float] | None = None,
    tolerance: tuple[float, float] = TOLERANCE,
) -> list[Check]:
    """The checks of one camera's matches.

    Args:
        findings: of the matcher.
        camera: whose.
        shared_sigmas: rotation [rad], translation [m] of the error that all its frames share; None
            where the error bar holds it.
        tolerance: of the user [deg, cm].
    """
    shared = None if shared_sigmas is None else np.repeat(shared_sigmas, 3)
    return [
        *_search_checks(findings, camera),
        *_share_checks(findings, camera),
        *check_sigmas("error that the matcher's frames share", shared, tolerance),
        *_agreement_checks(findings, camera),
    ]


def _agreement_checks(findings: MatcherFindings, camera: str) -> list[Check]:
    """Whether image and cloud agree better than by chance.

    A search in few frames measures that; its finding stands unless the rounds have lost the pose.
    """
    z_score, chance = findings.z_score.get(camera), findings.chance.get(camera)
    if chance is not None and camera in findings.missed:
        return []  # the check of the search has it
    if chance is not None and z_score is not None and not _is_lost(z_score):
        return [threshold("chance").check(chance)]
    return [] if z_score is None else [threshold("z_score").check(z_score)]


def _is_lost(z_score: float) -> bool:
    """Whether a pose of this z-score after the last round may well be one by chance."""
    return probability_by_chance(z_score, ALONE, _OF_FEW_FRAMES) > FAIL_ABOVE


def _search_checks(findings: MatcherFindings, camera: str) -> list[Check]:
    """Whether the matcher's global search found the camera, if it searched."""
    missed, found = findings.missed.get(camera), findings.found.get(camera)
    chance = findings.chance.get(camera)
    if missed is not None and chance is not None:
        text = (
            f"not found: where image and cloud agree best (z-score {missed:.1f}), a search with "
            f"nothing to find would agree as well with a probability of {chance:.2g}. One to three "
            "frames often show too little: give more frames, from more places, or a nearer guess"
        )
        return [Check("search", "FAIL", text, missed, kind="search_in_few_frames")]
    if missed is not None:
        text = (
            "no extrinsic within the matcher's range explains the images (best z-score "
            f"{missed:.1f} of image and cloud): check the guess, the intrinsics and the pairing, "
            "widen --search-deg and --search-m, or give more frames from more places"
        )
        return [Check("search", "FAIL", text, missed)]
    if found is not None:
        text = f"z-score {found:.1f} of image and cloud where the rounds began"
        return [Check("search", "PASS", text, found), *_contradiction(findings, camera)]
    return []


def _contradiction(findings: MatcherFindings, camera: str) -> list[Check]:
    """That what two cameras see in common places them where neither image accepts its pose."""
    other = findings.contradicted.get(camera)
    if other is None:
        return []
    text = (
        f"its image and cloud agree at its pose, but features that it has in common with {other} "
        "place the two cameras elsewhere: do both images show the same thing that is no part of "
        "the scene, as a text, a logo or a part of the vehicle? Else one of the two is wrong"
    )
    return [Check(f"features in common with {other}", "WARN", text, kind="contradiction")]


def _share_checks(findings: MatcherFindings, camera: str) -> list[Check]:
    """Checks of a learned matcher: dependence on its start, memorization, failed frames."""
    shares = (
        (threshold("start_dependence"), findings.start_dependence.get(camera),
         "of a displaced start remains in the matches"),
        (threshold("memorization"), findings.memorization.get(camera),
         "of a displaced start is undone even without the image"),
        (threshold("failed_frames"), findings.failed_share.get(camera, 0.0),
         "of the frames failed to be matched"),
    )  # fmt: skip
    return [_check_share(row, share, text) for row, share, text in shares if share is not None]


def _check_share(row: Threshold, share: float, text: str) -> Check:
    found = "an unknown share" if math.isnan(share) else f"{share:.0%}"
    status = row.grade(share)
    advice = f": {row.advice}" if row.advice and status != "PASS" else ""
    return row.describe(share, status, f"{found} {text}{advice}")
