"""Rounds that go on from where the images agree better, if the rounds before ended elsewhere.

Coarse levels can lead the rounds to a pose a degree off, as over grass and asphalt. There fine
levels agree hardly better than by chance, and find no way back. The posterior of the pose by the
fine scores covers a degree about the result. If more than half of its mass is elsewhere, its
densest sample there is the start of the last rounds. (Their mean may lie between modes, and differs
from start to start.) The end of these rounds is taken if the cameras agree better there.

The posterior that chose the pose cannot vouch for it: such a camera is WARN at best.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.matching.run import MatchingRun, Rematch
from calibgraph.model.geometry import pose_difference
from calibgraph.model.rig import Rig
from calibgraph.overlaps import refine_with_camera_pairs
from calibgraph.rematch import LastRound, rounds_from, with_cameras_of
from calibgraph.rounds import assign_places
from calibgraph.solver.joint import solve_without_failing
from calibgraph.trust.evidence import Evidence, RunEvidence

_TIMES = 3  # at most: a posterior that its prior cuts off shows the way, not the end
_log = logging.getLogger(__name__)


def go_on_elsewhere(evidence: RunEvidence) -> RunEvidence:
    """The evidence of the run, or of one whose rounds have gone on."""
    T_first = evidence.run.solution.solved_rig.T_camera_lidar
    for _ in range(_TIMES):
        if evidence.run.out_of_time or not evidence.run.matcher.tracking_rounds:
            break
        groups = groups_elsewhere(evidence.solution)
        run = _go_on(evidence, groups, T_first) if groups else None
        if run is None:
            break
        evidence = replace(evidence, run=run)
    return evidence


def groups_elsewhere(solution: Evidence) -> list[tuple[str, ...]]:
    """The groups of tied cameras whose posterior has more than half of its mass elsewhere."""
    found = solution.posteriors  # of no camera without images, or without a covariance
    return [each for each in solution.tied if each[0] in found and found[each[0]].share > 1 / 2]


def _go_on(
    evidence: RunEvidence, groups: Sequence[tuple[str, ...]], T_first: Mapping[str, Array]
) -> MatchingRun | None:
    """The run with the groups that agree better at the end of rounds from there; None if none."""
    run, posteriors = evidence.run, evidence.solution.posteriors
    rig = run.solution.solved_rig
    densest = {name: posteriors[name].elsewhere[0] for group in groups for name in group}
    start = rig.moved_to({
        name: gtsam.Pose3.Expmap(twist).matrix() @ rig.T_camera_lidar[name]
        for name, twist in densest.items()
    })  # fmt: skip
    fine = run.matcher.tracking_rounds[-1:]
    try:
        with run.watch("match_again"):
            again = rounds_from(
                run, start, (*fine, run.matcher.rounds - 1), evidence.progress,
                solve=solve_without_failing,
            )  # fmt: skip
            if again is None:
                return None
            better = {n for group in groups if _agrees_better(run, again, group) for n in group}
            if not better:
                return None
            run = _note(with_cameras_of(run, again, better), T_first, better)
            run = assign_places(replace(run, rematch=_without(run.rematch, better)))
        return refine_with_camera_pairs(run, evidence.progress)
    except CorrespondenceError as error:
        _log.info("rounds from where the images agree better: %s", error)
        return None
    finally:
        run.matcher.release()


def _agrees_better(run: MatchingRun, again: LastRound, group: tuple[str, ...]) -> bool:
    before, now = (t.findings.z_score for t in (run.correspondences, again.correspondences))
    return sum(now.get(name, 0.0) for name in group) > sum(before.get(name, 0.0) for name in group)


def _note(run: MatchingRun, T_first: Mapping[str, Array], names: set[str]) -> MatchingRun:
    """The run, with how far some cameras are by now from where the rounds ended first."""
    T = run.solution.T_camera_lidar
    moved = {name: pose_difference(T_first[name], T[name]) for name in names}
    for name, (degrees, centimetres) in moved.items():
        _log.info("%s: rounds went on, by %.2g deg, %.2g cm", name, degrees, centimetres)
    return replace(run, went_on={**run.went_on, **moved})


def _without(rematch: Rematch | None, names: set[str]) -> Rematch | None:
    """The test from a displaced start, of the cameras that stayed.

    Of others it tested a pose that is no longer the result; that their rounds depend on the start
    is known, and noted.
    """
    if rematch is None or names >= {*rematch.first.cameras}:
        return None
    kept = {name: camera for name, camera in rematch.first.cameras.items() if name not in names}
    return replace(rematch, first=Rig(cameras=kept))
