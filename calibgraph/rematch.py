"""Rounds from another start: whether they end at the same pose, or at a better one."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibgraph.errors import CorrespondenceError
from calibgraph.matching.run import (
    MatchingRun,
    Rematch,
    RoundSummary,
    summarize_round,
    with_motion,
)
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.metrics import perturb
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.solution import Solution
from calibgraph.trust.matcher_checks import REMATCH_DEG, REMATCH_M, compare_ends

_BETTER = 1.03
"""Ratio of z-scores from which the end of a displaced start replaces the first end. On KITTI, ends
8 to 12 cm off had 8 to 16 % lower z-scores than those at 3 cm; equally good ends differ by a few
percent."""


def rematch(run: MatchingRun, progress: Progress) -> MatchingRun:
    """Match again from a start displaced from the result, if the matcher names rounds for it.

    Where an objective is flat, as along the axis of a camera in a straight street, rounds may end
    before its top. A camera whose second end has a clearly higher z-score is taken from there,
    unless the ends are so far apart that the camera fails.
    """
    rounds = run.matcher.tracking_rounds
    if not rounds or not run.solution.objective.uses_correspondences:
        return run
    first = run.solution.solved_rig
    try:
        start = perturb(
            first, rotation_deg=REMATCH_DEG, translation_m=REMATCH_M, seed=run.solution.config.seed
        )
        again = rounds_from(run, start, (*rounds, run.matcher.rounds - 1), progress)
        if again is None:
            return run
        run = replace(run, rematch=Rematch(first, again.solution.solved_rig))
        better = _better_cameras(run, again)
        return with_cameras_of(run, again, better) if better else run
    except CorrespondenceError as error:
        return replace(run, rematch=Rematch(first, None, str(error)))


@dataclass(frozen=True, eq=False)
class LastRound:
    """A last round: its correspondences, their solution, how far it moved the cameras."""

    correspondences: Correspondences
    solution: Solution
    summary: RoundSummary


def rounds_from(
    run: MatchingRun,
    start: Rig,
    rounds: Sequence[int],
    progress: Progress,
    *,
    solve: Callable[..., Solution] = solve_joint,
) -> LastRound | None:
    """The last of some rounds from another start; None if the time is over before their end.

    Args:
        run: with the data, the matcher and the settings.
        start: where the cameras are at the first of the rounds.
        rounds: their numbers.
        progress: called as the work goes on.
        solve: how the matches of a round are solved.

    Raises:
        CorrespondenceError: if a camera gets too few correspondences.
    """
    config, terms = run.solution.config, run.solution.terms
    places, estimate, last = run.correspondences.places, start, None
    for index in dict.fromkeys(rounds):
        if run.is_late():
            return None
        table = run.matcher.match(
            run.dataset,
            estimate,
            round_index=index,
            progress=lambda what, done, total: progress("matching again", done, total),
        )
        table = with_motion(table, run.dataset).with_places(places)
        solution = solve(estimate.with_lenses_of(run.guess), table, config, terms)
        last = LastRound(table, solution, summarize_round(table, estimate, solution.solved_rig))
        estimate = solution.solved_rig
    return last


def _better_cameras(run: MatchingRun, again: LastRound) -> set[str]:
    """The cameras with a higher z-score at the second end, which is not far from the first."""
    before, now = (t.findings.z_score for t in (run.correspondences, again.correspondences))
    near = {
        name
        for name, checks in compare_ends(run.rematch).items()
        if all(check.status != "FAIL" for check in checks)
    }
    return {n for n in near if now.get(n, -np.inf) > _BETTER * before.get(n, np.inf)}


def with_cameras_of(run: MatchingRun, again: LastRound, better: Collection[str]) -> MatchingRun:
    """The run with some cameras' correspondences, starts and summaries of the second end."""
    parts = [
        (again.correspondences if name in better else run.correspondences).of_camera(name)
        for name in run.guess.cameras
    ]
    findings = run.correspondences.findings
    found = again.correspondences.findings.z_score
    z_score = {**findings.z_score, **{name: found[name] for name in better if name in found}}
    mixed = concatenate(parts).with_metadata(run.correspondences.metadata)
    mixed = mixed.with_findings(replace(findings, z_score=z_score))
    second = again.solution.rig.T_camera_lidar
    at_prior = run.solution.rig.with_lenses_of(run.guess)
    start = at_prior.moved_to({name: second[name] for name in better})
    settings = run.solution.config, run.solution.terms
    last = {**run.rounds[-1], **{name: again.summary[name] for name in better}}
    return replace(
        run,
        correspondences=mixed,
        solution=solve_joint(start, mixed, *settings),
        rounds=(*run.rounds[:-1], last),
    )
