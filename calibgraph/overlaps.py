"""What cameras see in common, added to the last round's solution."""

from dataclasses import replace

from calibgraph.errors import CalibrationError
from calibgraph.matching.camera_pairs import (
    PAIR_FRAMES,
    match_cameras,
    overlapping_pairs,
    with_surfaces,
)
from calibgraph.matching.run import MatchingRun
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.progress import Progress
from calibgraph.solver.joint import add_camera_pairs
from factors.columns import CLOCK


def refine_with_camera_pairs(run: MatchingRun, progress: Progress) -> MatchingRun:
    """Match the cameras with each other, and refine the solution with what they see in common.

    Not the cameras that the matcher did not find, nor a pair whose features contradict what it
    found: they would spoil the others.

    Args:
        run: all of its rounds are done.
        progress: called as the images are matched.

    Returns:
        The run itself where no two cameras can overlap, there is no time left, the terms do not use
        the correspondences, or the files, which its matcher may not have needed, cannot be read.
    """
    if run.out_of_time or not run.solution.objective.uses_correspondences:
        return run
    try:
        matches = _match_cameras(run, progress)
        return run if matches is None else _refine(run, matches)
    except (CalibrationError, OSError):  # the checks on images report it
        return run


def _match_cameras(run: MatchingRun, progress: Progress) -> CameraMatches | None:
    """The matches of the cameras that can overlap; None if there are none."""
    with run.watch("match_cameras"):
        findings = run.correspondences.findings
        missed, other = findings.missed.keys(), findings.contradicted
        cloud = run.dataset.frames[0].load_cloud()
        near = overlapping_pairs(run.solution.solved_rig, cloud)
        pairs = [(a, b) for a, b in near if missed.isdisjoint((a, b)) and other.get(a) != b]
        if not pairs:
            return None
        rig = run.guess.with_lenses_of(run.solution.solved_rig)  # as far as they are estimated
        seed = run.solution.config.seed
        return match_cameras(
            run.dataset, rig, pairs, most_frames=PAIR_FRAMES, seed=seed, progress=progress
        )


def _refine(run: MatchingRun, matches: CameraMatches) -> MatchingRun:
    """The run with the solution of correspondences and camera matches.

    Surfaces show where cameras are when they take an image. Where that is to be estimated they are
    left out: two cameras show each other alone.
    """
    solution = run.solution
    clock_is_free = not {*CLOCK}.isdisjoint(solution.config.estimate)
    with run.watch("solve_pairs"):
        if not clock_is_free:
            matches = with_surfaces(matches, run.dataset, solution.solved_rig)
        return replace(run, solution=add_camera_pairs(solution, matches))
