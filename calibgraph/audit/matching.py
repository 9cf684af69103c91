"""Rounds of matching that begin at a deployed rig, without a search."""

from collections.abc import Sequence
from contextlib import suppress

from calibgraph.errors import CorrespondenceError
from calibgraph.io.dataset import Dataset
from calibgraph.matching.protocol import FullMatcher
from calibgraph.matching.run import MatchingRun
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import pose_difference
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Status
from calibgraph.progress import Progress, Stopwatch
from calibgraph.rounds import find_stationary, run_rounds
from calibgraph.solver.joint import solve_without_failing
from calibgraph.solver.solution import Solution
from calibgraph.trust.thresholds import threshold

_REACH_DEG, _REACH_CM = 0.7, 20.0
"""Errors of the start that the tracking rounds correct."""


def match_from_deployed(
    data: Dataset,
    deployed: Rig,
    matcher: FullMatcher,
    config: Config,
    *,
    watch: Stopwatch,
    progress: Progress,
) -> MatchingRun:
    """Match in as few rounds as settle: the last tracking round, all of these, or all rounds.

    Raises:
        CorrespondenceError: if no camera has enough correspondences.
    """
    tracking, places = matcher.tracking_rounds, find_stationary(data, deployed)

    def find(at: Rig, index: int) -> Correspondences:
        with watch("match"):
            table = matcher.match(data, at, round_index=index, progress=progress)
            return table.with_places(places)

    def solve(at: Rig, table: Correspondences) -> Solution:
        with watch("solve"):
            return solve_without_failing(at, table, config)

    def match(rounds: Sequence[int]) -> MatchingRun:
        *_, (table, solution, done) = run_rounds(deployed, rounds, find, solve)
        return MatchingRun(data, matcher, deployed, table, solution, done, watch, progress=progress)

    if not tracking:
        return match(range(matcher.rounds))
    if len(tracking) > 1:  # the last alone, if it ends where it begins, as a converged run
        with suppress(CorrespondenceError):
            run = match(tracking[-1:])
            if not run.solution.held and _has_settled(run, still="PASS"):
                return run
    run = match(tracking)
    return run if _has_settled(run) else match((0, *tracking))


def _has_settled(run: MatchingRun, still: Status = "WARN") -> bool:
    """Whether every camera ended within reach, with a good z-score, after a short last step."""
    z_scores, last = run.correspondences.findings.z_score, run.rounds[-1]
    deployed, ended = run.guess.T_camera_lidar, run.solution.solved_rig.T_camera_lidar
    for name, T in deployed.items():
        degrees, centimetres = pose_difference(ended[name], T)
        grades = [
            threshold("last_round_rotation").grade(last[name]["moved_deg"]),
            threshold("last_round_translation").grade(last[name]["moved_cm"]),
        ]
        is_good = threshold("z_score").grade(z_scores.get(name, 0.0)) == "PASS"
        is_near = degrees <= _REACH_DEG and centimetres <= _REACH_CM
        if not (is_good and is_near and {*grades} <= {"PASS", still}):
            return False
    return True
