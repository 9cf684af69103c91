"""Cross-validation: frames that were held out, displaced starts, and a competing solution."""

from __future__ import annotations

import math
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError
from calibgraph.model.geometry import pose_difference
from calibgraph.model.perturbation import perturb_extrinsics
from calibgraph.model.verdict import Check
from calibgraph.parallel import map_on_cores
from calibgraph.solver.camera_block import CameraBlock, camera_block
from calibgraph.solver.objective import Objective, Transforms
from calibgraph.solver.pnp import RANSAC_ITERATIONS, frame_pose
from calibgraph.solver.solution import Solution
from calibgraph.solver.spread_kernel import median
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.thresholds import limit, threshold

Array = NDArray[np.float64]

RESTARTS, RESTART_DEG, RESTART_M = 3, 2.0, 0.2
"""How many displaced starts, and how far they are from the solution."""

_RESTART_SAMPLE = 5000  # matches of a camera that first lead back from a displaced start
_MET_DEG, _MET_CM = 0.01, 0.3  # a tenth of the check's limit: starts that have come together
_ROUGH = 1e-6  # relative change of the cost at which their first pass stops: the gate needs no more
_FEWEST_ITERATIONS = 50  # of MAGSAC, which also polishes its result
_MISSED = 1e-6  # probability that no sample of a competing solution large enough to count is clean


def held_out_checks(evidence: Evidence) -> Checks:
    """Ratio of the error of held-out frames to the error of fitted frames."""
    row = threshold("held_out")
    return {
        name: [row.check(_held_out_ratio(block, evidence.halves[name], evidence.even_frames))]
        for name, block in evidence.fitted_blocks.items()
        if name in evidence.halves
    }


def _held_out_ratio(
    block: CameraBlock, halves: tuple[Array, Array], even_frames: NDArray[np.int64]
) -> float:
    """Ratio of the median error of held-out frames to the median error of fitted frames."""
    even = block.in_frames(even_frames)
    errors = [block.errors_px(T)[0] for T in halves]
    fitted = np.concatenate([errors[0][even], errors[1][~even]])
    held_out = np.concatenate([errors[0][~even], errors[1][even]])
    return median(held_out) / max(median(fitted), float(np.finfo(float).tiny))


def restart_checks(evidence: Evidence) -> Checks:
    """How far from the solution the solves from displaced starts end, at worst."""
    if not evidence.fitted_blocks:
        return {}
    solution = evidence.of_correspondences.solution
    T_camera_lidar = solution.T_camera_lidar
    displaced = [
        {name: T_delta @ T for T_delta, (name, T) in zip(each, T_camera_lidar.items(), strict=True)}
        for each in _displacements(len(T_camera_lidar))
    ]
    ends = _ends_from(solution, displaced)
    starts = f"{RESTART_DEG:g} deg, {RESTART_M * 100:g} cm off"
    name = f"solving again from starts {starts}: largest difference"
    checks, tolerance = {}, solution.config.tolerance
    for camera in evidence.fitted_blocks:
        differences = [
            (180.0, np.inf) if end is None else pose_difference(end[camera], T_camera_lidar[camera])
            for end in ends
        ]
        degrees, centimetres = np.max(differences, axis=0)
        checks[camera] = [
            threshold("restart_rotation", tolerance).check(degrees, name=name),
            threshold("restart_translation", tolerance).check(centimetres, name=name),
        ]
    return checks


@cache
def _displacements(cameras: int) -> list[list[Array]]:
    """Per restart, the (4, 4) T_delta of each camera."""
    unmoved = {str(camera): np.eye(4) for camera in range(cameras)}
    return [
        [
            *perturb_extrinsics(
                unmoved, rotation_deg=RESTART_DEG, translation_m=RESTART_M, seed=seed
            ).values()
        ]
        for seed in range(RESTARTS)
    ]


def _ends_from(solution: Solution, starts: list[Transforms]) -> list[Transforms | None]:
    """The T_camera_lidar from each start; None where too few matches are kept.

    First coarsely with a selection of the matches, then both passes with all of them; starts that
    have come together by then go on as one.
    """
    coarse = solution.objective.coarse(_RESTART_SAMPLE)
    near = map_on_cores(partial(_solve_coarsely, coarse), starts)
    distinct: list[Transforms] = []
    number_of = [_number_among(distinct, each) for each in near]
    ends = map_on_cores(partial(_solve_from, solution), distinct)
    return [None if number is None else ends[number] for number in number_of]


def _number_among(distinct: list[Transforms], near: Transforms | None) -> int | None:
    """Which of the distinct ones it has come together with; added to them if with none."""
    if near is None:
        return None
    for number, other in enumerate(distinct):
        if _have_met(near, other):
            return number
    distinct.append(near)
    return len(distinct) - 1


def _have_met(first: Transforms, second: Transforms) -> bool:
    """Whether all cameras are where further steps would lead to one minimum."""
    return all(
        pose_difference(T, second[name])[0] < _MET_DEG
        and pose_difference(T, second[name])[1] < _MET_CM
        for name, T in first.items()
    )


def _solve_coarsely(coarse: Objective, start: Transforms) -> Transforms | None:
    try:
        return coarse.minimize_with_scale(start)[0]
    except CorrespondenceError:
        return None


def _solve_from(solution: Solution, start: Transforms) -> Transforms | None:
    """Both passes, with all matches; None if too few are kept."""
    objective = solution.objective
    try:
        rough, scales = objective.with_tolerance(_ROUGH).minimize_with_scale(start)
        return objective.without_outliers(rough, scales).minimize(rough, scales).T_camera_lidar
    except CorrespondenceError:
        return None


def competing_solution_checks(evidence: Evidence) -> Checks:
    """Whether the matches that a solution leaves out agree on another extrinsic."""
    solution = evidence.of_correspondences.solution
    return {name: [check_competing_solution(solution, name)] for name in evidence.fitted_blocks}


def check_competing_solution(solution: Solution, camera: str) -> Check:
    """Ratio of the matches that agree on another extrinsic alone to those on this one alone."""
    row = threshold("competing_solution")
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
    same = degrees < limit("competing_rotation") and centimetres < limit("competing_translation")
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
