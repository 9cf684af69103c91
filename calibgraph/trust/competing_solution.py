"""Whether the matches that a solution leaves out agree on another one."""

from __future__ import annotations

import math

from calibgraph.model.geometry import pose_difference
from calibgraph.model.verdict import Check
from calibgraph.solver.camera_block import CameraBlock, camera_block
from calibgraph.solver.pnp import RANSAC_ITERATIONS, frame_pose
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.thresholds import limit, threshold

_FEWEST_ITERATIONS = 50  # of MAGSAC, which also polishes its result
_MISSED = 1e-6  # probability that no sample of a competing solution large enough to count is clean


def competing_solution_checks(evidence: Evidence) -> Checks:
    """Whether the matches that a solution leaves out agree on another extrinsic."""
    solution = evidence.of_correspondences.solution
    return {name: [check_competing_solution(solution, name)] for name in evidence.fitted_blocks}


def check_competing_solution(solution: Solution, camera: str) -> Check:
    """Ratio of the matches that agree on another extrinsic alone to those on this one alone."""
    row, tolerance = threshold("competing_solution"), solution.config.tolerance
    block, gate_px = _of_all_frames(solution, camera), solution.scales[camera].gate_px
    ours = block.within_gate(solution.T_camera_lidar[camera], gate_px)
    left_out = block.block.select(~ours)
    T = None
    if len(left_out):
        iterations = _ransac_iterations(row.warn * int(ours.sum()), len(left_out))
        T = frame_pose(
            solution.rig.cameras[camera], left_out, solution.config, iterations=iterations
        )
    if T is None:
        return row.describe(0.0, "PASS", f"{row.name}: none")
    theirs = block.within_gate(T, gate_px)
    degrees, centimetres = pose_difference(T, solution.T_camera_lidar[camera])
    same = degrees < limit("competing_rotation", tolerance)
    same = same and centimetres < limit("competing_translation", tolerance)
    only_theirs, only_ours = int((theirs & ~ours).sum()), int((ours & ~theirs).sum())
    share = 0.0 if same else only_theirs / max(only_ours, 1)
    advice = f"the other is {degrees:.2g} deg, {centimetres:.2g} cm away; which one is right?"
    return row.check(share, advice=advice)


def _of_all_frames(solution: Solution, camera: str) -> CameraBlock:
    """All matches of a camera, outlier frames included: they may agree on another pose."""
    if not solution.counts[camera]["outlier_frames"]:
        return solution.objective.blocks[camera]
    rows = solution.correspondences.of_camera(camera)
    return camera_block(solution.rig.cameras[camera], rows, solution.config)


def _ransac_iterations(fewest: float, matches: int) -> int:
    """Samples of 4 matches that find a competing solution if it is large enough for a warning."""
    share = min(fewest / 2 / matches, 0.99)
    needed = math.log(_MISSED) / math.log1p(-(share**4)) if share > 0 else math.inf
    return int(min(max(needed, _FEWEST_ITERATIONS), RANSAC_ITERATIONS))
