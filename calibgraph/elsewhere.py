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
from calibgraph.matching.run import MatchingRun
from calibgraph.model.geometry import pose_difference
from calibgraph.rounds import (
    assign_places,
    better_cameras,
    refine_with_camera_pairs,
    run_again,
    with_cameras_of,
)
from calibgraph.trust.evidence import Evidence, gather_of_run

_TIMES = 3  # at most: a posterior that its prior cuts off shows the way, not the end
_log = logging.getLogger(__name__)


def go_on_elsewhere(run: MatchingRun) -> tuple[MatchingRun, Evidence]:
    """The run, or one whose rounds have gone on, with the evidence of its solution."""
    T_first, evidence = run.solution.T_camera_lidar, gather_of_run(run)
    for _ in range(_TIMES):
        if run.out_of_time or not run.matcher.tracking_rounds:
            break
        found = evidence.posteriors  # of no camera without images, or without a covariance
        groups = [g for g in evidence.tied if g[0] in found and found[g[0]].share > 1 / 2]
        after = _go_on(run, evidence, groups, T_first) if groups else None
        if after is None:
            break
        run, evidence = after, gather_of_run(after)
    return run, evidence


def _go_on(
    run: MatchingRun,
    evidence: Evidence,
    groups: Sequence[tuple[str, ...]],
    T_first: Mapping[str, Array],
) -> MatchingRun | None:
    """The run with the groups that agree better at the end of rounds from there; None if none."""
    rig, posteriors = run.solution.solved_rig, evidence.posteriors
    start = rig.moved_to({
        name: gtsam.Pose3.Expmap(posteriors[name].elsewhere[0]).matrix() @ rig.T_camera_lidar[name]
        for group in groups
        for name in group
    })  # fmt: skip
    fine = run.matcher.tracking_rounds[-1:]
    try:
        with run.watch("match_again"):
            again = run_again(run, start, fine)
            better = [] if again is None else better_cameras(run, again, groups)
            if again is None or not better:
                return None
            run = with_cameras_of(run, again, better)
            T = run.solution.T_camera_lidar
            moved = {name: pose_difference(T_first[name], T[name]) for name in better}
            _log.info("rounds went on, by deg, cm: %s", moved)
            # Of these the test from a displaced start was of a pose that is no longer the result.
            kept = {name: ends for name, ends in run.rematch.items() if name not in better}
            run = replace(run, went_on={**run.went_on, **moved}, rematch=kept)
            run = assign_places(run)
        return refine_with_camera_pairs(run)
    except CorrespondenceError as error:
        _log.info("rounds from where the images agree better: %s", error)
        return None
    finally:
        run.matcher.release()
