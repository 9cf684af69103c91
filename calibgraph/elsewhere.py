"""Rounds that go on from where the images agree better, if the rounds before ended elsewhere.

Coarse levels can lead the rounds to a pose a degree off, as over grass and asphalt. There fine
levels agree hardly better than by chance, and find no way back. The posterior of the pose by the
fine scores covers a degree about the result. If more than half of its mass is elsewhere, its
densest samples there, farther apart than the tolerance, are starts of the last rounds. (Their mean
may lie between modes, and the densest alone misses the right one.) The end at which the cameras
agree best is taken, if it is better than the result.

The posterior that chose the pose cannot vouch for it: such a camera is WARN at best.
"""

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import gtsam
import numpy as np

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
_STARTS = 4  # each time, at most
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
    samples = {name: found.elsewhere for name, found in evidence.posteriors.items()}
    modes = {g: _find_modes(samples[g[0]], run.solution.config.tolerance) for g in groups}
    T, ended, better = run.solution.T_camera_lidar, run, set[str]()
    with run.watch("match_again"):
        for number in range(max(map(len, modes.values()))):
            start = run.solution.solved_rig.moved_to({
                name: gtsam.Pose3.Expmap(samples[name][found[number]]).matrix() @ T[name]
                for group, found in modes.items()
                for name in (group if number < len(found) else ())
            })  # fmt: skip
            with suppress(CorrespondenceError):
                again = run_again(run, start, run.matcher.tracking_rounds[-1:])
                if again is None:
                    break
                if names := better_cameras(ended, again, groups):
                    ended, better = with_cameras_of(ended, again, names), better.union(names)
    run.matcher.release()
    if not better:
        return None
    T = ended.solution.T_camera_lidar
    moved = {name: pose_difference(T_first[name], T[name]) for name in better}
    _log.info("rounds went on, by deg, cm: %s", moved)
    # Of these the test from a displaced start was of a pose that is no longer the result.
    kept = {name: ends for name, ends in run.rematch.items() if name not in better}
    ended = replace(ended, went_on={**run.went_on, **moved}, rematch=kept)
    return refine_with_camera_pairs(assign_places(ended))


def _find_modes(samples: Array, tolerance: tuple[float, float]) -> list[int]:
    """Numbers of (n, 6) samples, the densest first, apart from the result and from each other."""
    numbers, found, last = np.arange(len(samples)), list[int](), np.zeros(6)
    while len(found) < _STARTS:
        degrees, cm = np.linalg.norm((samples[numbers] - last).reshape(-1, 2, 3), axis=2).T
        numbers = numbers[(np.degrees(degrees) > tolerance[0]) | (100 * cm > tolerance[1])]
        if not len(numbers):
            break
        found.append(int(numbers[0]))
        last = samples[numbers[0]]
    return found
