"""Checks of the matcher's findings, and of its rounds: convergence, repeats, the second end."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

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
from calibgraph.trust.evidence import Evidence, Found
from calibgraph.trust.inputs import describe_copies, describe_repeats
from calibgraph.trust.thresholds import threshold

_OF_FEW_FRAMES = Chance(5.7, 0.0, SEARCH.scale)  # in which the search has measured the location


def matcher_checks(evidence: Evidence) -> Found:
    """The checks of every camera's matches, by what its matcher states."""
    table, findings = evidence.solution.correspondences, evidence.findings
    for name in evidence.cameras:
        chance = findings.chance.get(name)
        if chance is not None and len(np.unique(table.of_camera(name).frame)) > FEW_FRAMES:
            chance = None  # in so many no search measures what is found by chance
        for checks in (_search_checks, _match_checks):
            yield from ((name, check) for check in checks(findings, name, chance))


def _match_checks(findings: MatcherFindings, camera: str, chance: float | None) -> Iterator[Check]:
    """Dependence on the start, memorization, failed frames; if all agrees better than by chance.

    A search in few frames measures that; its finding stands unless the rounds have lost the pose.
    """
    shares = (
        ("start_dependence", findings.start_dependence.get(camera),
         "of a displaced start remains in the matches"),
        ("memorization", findings.memorization.get(camera),
         "of a displaced start is undone even without the image"),
        ("failed_frames", findings.failed_share.get(camera, 0.0),
         "of the frames failed to be matched"),
    )  # fmt: skip
    for key, share, text in shares:
        if share is not None:
            part = "an unknown share" if math.isnan(share) else f"{share:.0%}"
            yield threshold(key).check(share, f"{part} {text}")
    z_score = findings.z_score.get(camera)
    if z_score is None or (chance is not None and camera in findings.missed):
        return  # the check of the search has it
    is_lost = probability_by_chance(z_score, ALONE, _OF_FEW_FRAMES) > FAIL_ABOVE
    if chance is not None and not is_lost:
        yield threshold("chance").check(chance)
    else:
        yield threshold("z_score").check(z_score)


def _search_checks(findings: MatcherFindings, camera: str, chance: float | None) -> Iterator[Check]:
    """Whether the matcher's global search found the camera, and what it has in common agrees."""
    missed, found = findings.missed.get(camera), findings.found.get(camera)
    if missed is not None and chance is not None:
        text = (
            f"not found: where image and cloud agree best (z-score {missed:.1f}), a search with "
            f"nothing to find would agree as well with a probability of {chance:.2g}. One to three "
            "frames often show too little: give more frames, from more places, or a nearer guess"
        )
        yield Check("search", "FAIL", text, missed, kind="search_in_few_frames")
    elif missed is not None:
        text = (
            "no extrinsic within the matcher's range explains the images (best z-score "
            f"{missed:.1f} of image and cloud): check the guess, the intrinsics and the pairing, "
            "search farther, or give more frames from more places"
        )
        yield Check("search", "FAIL", text, missed)
    elif found is not None:
        text = f"z-score {found:.1f} of image and cloud where the rounds began"
        yield Check("search", "PASS", text, found)
        if (other := findings.contradicted.get(camera)) is None:
            return
        text = (
            "its image and cloud agree at its pose, but features that it has in common with "
            f"{other} place the two cameras elsewhere: do both images show the same thing that is "
            "no part of the scene, as a text, a logo or a part of the vehicle? Are the clouds not "
            "corrected for the motion during a scan? Else one of the two is wrong"
        )
        yield Check(f"features in common with {other}", "WARN", text, kind="contradiction")


REMATCH_DEG, REMATCH_M = 0.5, 0.08
"""How far the start of matching again is displaced from the result."""


def last_round_checks(run: MatchingRun) -> Found:
    """How far the last of several rounds of matching still moved the cameras."""
    return check_moves(run.rounds, run.solution.config.tolerance)


def check_moves(rounds: Sequence[RoundSummary], tolerance: tuple[float, float]) -> Found:
    """How far the last of several rounds moved each camera, for a tolerance [deg, cm]."""
    for name, moved in rounds[-1].items() if len(rounds) > 1 else ():
        yield name, threshold("last_round_rotation", tolerance).check(moved["moved_deg"])
        yield name, threshold("last_round_translation", tolerance).check(moved["moved_cm"])


def repeated_file_checks(run: MatchingRun) -> Found:
    """Which frames were copies, and the first kind of file that others have in common, if any."""
    frames = [(f.name, f.image_paths, run.hashes[str(f.cloud_path)]) for f in run.dataset.frames]
    of_clouds = describe_repeats("cloud", [(name, digest) for name, _, digest in frames])
    copied = Check("copies", "WARN", describe_copies(run.copies), len(run.copies))
    for camera in run.guess.cameras:
        images = [(n, run.hashes[str(paths[camera])]) for n, paths, _ in frames if camera in paths]
        if run.copies:
            yield camera, copied
        if text := describe_repeats(f"image of {camera}", images) or of_clouds:
            yield camera, Check("equal files", "WARN", text)


def compare_ends(run: MatchingRun) -> Found:
    """Per camera, the difference between its result and the end from a displaced start."""
    start = f"matching again from a start {REMATCH_DEG:g} deg, {100 * REMATCH_M:g} cm off"
    tolerance = run.solution.config.tolerance
    for name, ends in run.rematch.items():
        if run.rematch_failure:
            text = f"{start} failed: {run.rematch_failure}"
            yield name, Check("matching again", "FAIL", text)
            continue
        for part, apart in zip(("rotation", "translation"), pose_difference(*ends), strict=True):
            row = threshold(f"rematch_{part}", tolerance)
            yield name, row.check(apart, name=f"{start}: difference")


def going_on_checks(run: MatchingRun) -> Found:
    """Which rounds ended elsewhere than the images allow, and went on from there."""
    for name, (degrees, centimetres) in run.went_on.items():
        text = (
            f"rounds of matching ended {degrees:.2g} deg, {centimetres:.2g} cm away, where the "
            "images agree less, and went on from where they agree better: this scene misleads "
            "coarse levels"
        )
        yield name, Check("rounds that went on", "WARN", text, degrees, kind=WENT_ON)


def time_limit_checks(run: MatchingRun) -> Found:
    """Whether the time limit left something out."""
    missed = f"{run.missed_rounds} rounds of matching and " if run.missed_rounds else ""
    text = f"partial: there was no time for {missed}the checks against the images"
    for name in run.guess.cameras if run.out_of_time else ():
        yield name, Check("time limit", "WARN", text, run.missed_rounds)
