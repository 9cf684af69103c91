"""Rounds from where the images say that cameras are, if the rounds before have ended elsewhere.

Coarse levels can lead the rounds to a pose a degree off, where fine levels agree as well as chance
lets them, and from which they find no way back: grass and asphalt lead so. The posterior of the
pose by the fine scores knows better poses within its reach. Where it tells that the rounds more
probably ended elsewhere than not, the densest of its samples there is the start of the last rounds:
it repeats, while the mean lies between modes. Their end is taken if the cameras agree better there
than at the first end.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import gtsam

from calibgraph.errors import CorrespondenceError
from calibgraph.matching.run import MatchingRun
from calibgraph.overlaps import refine_with_camera_pairs
from calibgraph.rematch import LastRound, rounds_from, with_cameras_of
from calibgraph.rounds import assign_places
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.run_evidence import RunEvidence

_TIMES = 3  # at most: a posterior that its prior cuts off shows the way, not the end


def follow_images(evidence: RunEvidence) -> RunEvidence:
    """The evidence of the run, or of one that goes on from where the images say."""
    for _ in range(_TIMES):
        if evidence.run.out_of_time or not evidence.run.matcher.tracking_rounds:
            return evidence
        groups = _elsewhere(evidence.solution)
        run = _go_on(evidence, groups) if groups else None
        if run is None:
            return evidence
        evidence = replace(evidence, run=run)
    return evidence


def _elsewhere(solution: Evidence) -> list[tuple[str, ...]]:
    """The groups of cameras that more probably ended elsewhere than not."""
    return [group for group in solution.tied if solution.posteriors[group[0]].share > 1 / 2]


def _go_on(evidence: RunEvidence, groups: Sequence[tuple[str, ...]]) -> MatchingRun | None:
    """The run with the groups that agree better at the end of rounds from there; None if none."""
    run, posteriors = evidence.run, evidence.solution.posteriors
    rig = run.solution.solved_rig
    densest = {name: posteriors[name].elsewhere[0] for group in groups for name in group}
    start = rig.moved_to({
        name: gtsam.Pose3.Expmap(twist).matrix() @ rig.T_camera_lidar[name]
        for name, twist in densest.items()
    })  # fmt: skip
    rounds = run.matcher.tracking_rounds[-1], run.matcher.rounds - 1
    with run.watch("match_again"), suppress(CorrespondenceError):
        again = rounds_from(run, start, rounds, progress=evidence.progress)
        better = [] if again is None else [g for g in groups if _agrees_better(run, again, g)]
        if again is not None and better:
            names = {name for group in better for name in group}
            run = assign_places(with_cameras_of(run, again, names))
            return refine_with_camera_pairs(run, evidence.progress)
    return None


def _agrees_better(run: MatchingRun, again: LastRound, group: tuple[str, ...]) -> bool:
    before, now = (t.findings.z_score for t in (run.correspondences, again.correspondences))
    return sum(now.get(name, 0.0) for name in group) > sum(before.get(name, 0.0) for name in group)
