"""Checks of the matcher's findings, and of its rounds: convergence, repeats, the second end."""

from __future__ import annotations

import math

import numpy as np

from calibgraph.matching.run import MatchingRun, RoundSummary
from calibgraph.matching.structure.acceptance import (
    FEW_FRAMES,
    SEARCH,
    Chance,
    probability_by_chance,
)
from calibgraph.matching.structure.global_search import ALONE
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_difference
from calibgraph.model.verdict import FAIL_ABOVE, WENT_ON, Check
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.inputs import describe_copies, describe_repeats
from calibgraph.trust.thresholds import threshold

_OF_FEW_FRAMES = Chance(5.7, 0.0, SEARCH.scale)  # in which the search has measured the location


def matcher_checks(evidence: Evidence) -> Checks:
    """The checks of every camera's matches, by what its matcher states."""
    table, findings = evidence.solution.correspondences, evidence.findings
    checks = {}
    for name in evidence.cameras:
        chance = findings.chance.get(name)
        if chance is not None and len(np.unique(table.of_camera(name).frame)) > FEW_FRAMES:
            chance = None  # in so many no search measures what is found by chance
        checks[name] = [
            *_search_checks(findings, name, chance),
            *_share_checks(findings, name),
            *_agreement_checks(findings, name, chance),
        ]
    return checks


def _agreement_checks(findings: MatcherFindings, camera: str, chance: float | None) -> list[Check]:
    """Whether image and cloud agree better than by chance.

    A search in few frames measures that; its finding stands unless the rounds have lost the pose.
    """
    z_score = findings.z_score.get(camera)
    if z_score is None or (chance is not None and camera in findings.missed):
        return []  # the check of the search has it
    is_lost = probability_by_chance(z_score, ALONE, _OF_FEW_FRAMES) > FAIL_ABOVE
    if chance is not None and not is_lost:
        return [threshold("chance").check(chance)]
    return [threshold("z_score").check(z_score)]


def _search_checks(findings: MatcherFindings, camera: str, chance: float | None) -> list[Check]:
    """Whether the matcher's global search found the camera, and what it has in common agrees."""
    missed, found = findings.missed.get(camera), findings.found.get(camera)
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
            "search farther, or give more frames from more places"
        )
        return [Check("search", "FAIL", text, missed)]
    if found is None:
        return []
    text = f"z-score {found:.1f} of image and cloud where the rounds began"
    checks = [Check("search", "PASS", text, found)]
    if (other := findings.contradicted.get(camera)) is not None:
        text = (
            "its image and cloud agree at its pose, but features that it has in common with "
            f"{other} place the two cameras elsewhere: do both images show the same thing that is "
            "no part of the scene, as a text, a logo or a part of the vehicle? Are the clouds not "
            "corrected for the motion during a scan? Else one of the two is wrong"
        )
        name = f"features in common with {other}"
        checks.append(Check(name, "WARN", text, kind="contradiction"))
    return checks


def _share_checks(findings: MatcherFindings, camera: str) -> list[Check]:
    """Checks of a learned matcher: dependence on its start, memorization, failed frames."""
    shares = (
        ("start_dependence", findings.start_dependence.get(camera),
         "of a displaced start remains in the matches"),
        ("memorization", findings.memorization.get(camera),
         "of a displaced start is undone even without the image"),
        ("failed_frames", findings.failed_share.get(camera, 0.0),
         "of the frames failed to be matched"),
    )  # fmt: skip
    return [
        threshold(key).check(
            share, f"{'an unknown share' if math.isnan(share) else f'{share:.0%}'} {text}"
        )
        for key, share, text in shares
        if share is not None
    ]


REMATCH_DEG, REMATCH_M = 0.5, 0.08
"""How far the start of matching again is displaced from the result."""


def last_round_checks(run: MatchingRun) -> Checks:
    """How far the last of several rounds of matching still moved the cameras."""
    return (
        {} if len(run.rounds) == 1 else check_moves(run.rounds[-1], run.solution.config.tolerance)
    )


def check_moves(summary: RoundSummary, tolerance: tuple[float, float]) -> Checks:
    """How far a round moved each camera, for a tolerance [deg, cm]."""
    keys = ("last_round_rotation", "moved_deg"), ("last_round_translation", "moved_cm")
    rows = [(threshold(key, tolerance), of) for key, of in keys]
    return {n: [row.check(moved[of]) for row, of in rows] for n, moved in summary.items()}


def repeated_file_checks(run: MatchingRun) -> Checks:
    """Which frames were copies, and the first kind of file that others have in common, if any."""
    frames = [(f.name, f.image_paths, run.hashes[str(f.cloud_path)]) for f in run.dataset.frames]
    of_clouds = describe_repeats("cloud", [(name, digest) for name, _, digest in frames])
    copied = Check("copies", "WARN", describe_copies(run.copies), len(run.copies))
    checks = {}
    for camera in run.guess.cameras:
        images = [(n, run.hashes[str(paths[camera])]) for n, paths, _ in frames if camera in paths]
        text = describe_repeats(f"image of {camera}", images) or of_clouds
        repeated = [Check("equal files", "WARN", text)] if text else []
        checks[camera] = [copied, *repeated] if run.copies else repeated
    return checks


def compare_ends(run: MatchingRun) -> Checks:
    """Per camera, the difference between its result and the end from a displaced start."""
    start = f"matching again from a start {REMATCH_DEG:g} deg, {100 * REMATCH_M:g} cm off"
    if run.rematch_failure:
        check = Check("matching again", "FAIL", f"{start} failed: {run.rematch_failure}")
        return {name: [check] for name in run.rematch}
    words = f"{start}: difference"
    tolerance = run.solution.config.tolerance
    rows = [threshold(f"rematch_{part}", tolerance) for part in ("rotation", "translation")]
    apart = {name: pose_difference(*ends) for name, ends in run.rematch.items()}
    return {
        name: [row.check(value, name=words) for row, value in zip(rows, values, strict=True)]
        for name, values in apart.items()
    }


def going_on_checks(run: MatchingRun) -> Checks:
    """Which rounds ended elsewhere than the images allow, and went on from there."""
    text = (
        "rounds of matching ended {:.2g} deg, {:.2g} cm away, where the images agree less, and "
        "went on from where they agree better: this scene misleads coarse levels"
    )
    return {
        name: [Check("rounds that went on", "WARN", text.format(*moved), moved[0], kind=WENT_ON)]
        for name, moved in run.went_on.items()
    }


def time_limit_checks(run: MatchingRun) -> Checks:
    """Whether the time limit left something out."""
    if not run.out_of_time:
        return {}
    missed = f"{run.missed_rounds} rounds of matching and " if run.missed_rounds else ""
    text = f"partial: there was no time for {missed}the checks against the images"
    check = Check("time limit", "WARN", text, run.missed_rounds)
    return {name: [check] for name in run.guess.cameras}
