"""A solution put to trial: judged by frames it has not seen, re-started, and against a rival."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError
from calibgraph.model.geometry import pose_difference
from calibgraph.model.perturbation import perturb
from calibgraph.model.verdict import Check, above
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock
from calibgraph.solver.objective import Objective, Transforms
from calibgraph.solver.pnp import frame_pose
from calibgraph.solver.solution import Solution

Array = NDArray[np.float64]

HELD_OUT_WARN, HELD_OUT_FAIL = 1.5, 3.0
"""How many times the error of the frames it was fitted to that of other frames may be."""

RESTARTS, RESTART_DEG, RESTART_M = 3, 2.0, 0.2
RESTART_WARN_DEG, RESTART_FAIL_DEG = 0.1, 0.5
RESTART_WARN_CM, RESTART_FAIL_CM = 3.0, 15.0
"""How far from the solution a solve may end that starts 2 degrees and 20 cm off."""

RIVAL_WARN, RIVAL_FAIL = 0.25, 0.5
RIVAL_APART_DEG, RIVAL_APART_CM = 0.3, 10.0
"""How many matches may agree on another extrinsic alone, by those that agree on this one alone."""


def halves_of(fit: Solution) -> dict[str, tuple[Array, Array]]:
    """Per camera the solutions from every other frame and from the frames between, if possible."""
    inliers = fit.inliers
    if not inliers.uses_correspondences:
        return {}
    even = even_frames(inliers)
    solutions = []
    for other in (False, True):
        part = {
            name: m.select(np.isin(m.frame, even, invert=other))
            for name, m in inliers.blocks.items()
        }
        if any(len(m.frame) < MIN_MATCHES for m in part.values()):
            return {}
        problem = inliers.with_blocks(part)
        solutions.append(problem.minimize(fit.T_camera_lidar, fit.scales).T_camera_lidar)
    return {name: (solutions[0][name], solutions[1][name]) for name in inliers.blocks}


def even_frames(inliers: Objective) -> NDArray[np.int64]:
    """Every other one of the frames that any camera has matches in."""
    return np.unique(np.concatenate([m.frame for m in inliers.blocks.values()]))[::2]


def held_out_check(
    matches: CameraBlock, halves: tuple[Array, Array], even_frames: NDArray[np.int64]
) -> Check:
    """The error of frames that a solution has not seen, over that of those it has.

    Args:
        matches: a camera's, not only those within the gate.
        halves: T_camera_lidar from the even frames, and from the frames between.
        even_frames: their numbers.
    """
    even = np.isin(matches.frame, even_frames)
    errors = [matches.errors_px(T)[0] for T in halves]
    seen = np.concatenate([errors[0][even], errors[1][~even]])
    unseen = np.concatenate([errors[0][~even], errors[1][even]])
    ratio = float(np.median(unseen) / max(np.median(seen), np.finfo(float).tiny))
    return above(
        "error of held-out frames over that of fitted ones", ratio,
        HELD_OUT_WARN, HELD_OUT_FAIL, "times", "too few matches for what was fitted to them",
    )  # fmt: skip


def restart_checks(fit: Solution) -> dict[str, list[Check]]:
    """Per camera, how far from the solution solves end that start somewhere near it."""
    if not fit.objective.uses_correspondences:
        return {}
    ends = [_restarted(fit, seed) for seed in range(RESTARTS)]
    advice = "the matches leave room for several solutions; give more of them, or better spread"
    name = f"after starts {RESTART_DEG:g} deg, {RESTART_M * 100:g} cm off, the solution differs by"
    checks = {}
    for camera in fit.objective.blocks:
        apart = [
            pose_difference(end[camera], fit.T_camera_lidar[camera])
            for end in ends
            if end is not None
        ]
        lost = [(180.0, np.inf)] * (RESTARTS - len(apart))
        degrees, centimetres = np.max([*apart, *lost], axis=0)
        checks[camera] = [
            above(name, degrees, RESTART_WARN_DEG, RESTART_FAIL_DEG, "deg", advice),
            above(name, centimetres, RESTART_WARN_CM, RESTART_FAIL_CM, "cm", advice),
        ]
    return checks


def _restarted(fit: Solution, seed: int) -> Transforms | None:
    """The solution from a perturbed start; None if it keeps too few matches."""
    start = perturb(
        fit.solved_rig, rotation_deg=RESTART_DEG, translation_m=RESTART_M, seed=seed
    ).T_camera_lidar
    try:
        poses, scales = fit.objective.minimize_with_scale(start)
        return fit.objective.without_outliers(poses, scales).minimize(poses, scales).T_camera_lidar
    except CorrespondenceError:
        return None


def competing_solution_check(fit: Solution, camera: str) -> Check:
    """Whether the matches that a camera's solution leaves out agree on another extrinsic."""
    matches, gate_px = fit.objective.blocks[camera], fit.scales[camera].gate_px
    ours = _inside(matches.errors_px(fit.T_camera_lidar[camera]), gate_px)
    table = matches.select(~ours).as_table(camera=camera)
    name = "matches that agree on another extrinsic, by those that agree on this one"
    T = frame_pose(fit.rig.cameras[camera], table, fit.config) if len(table) else None
    if T is None:
        return Check(name, "PASS", f"{name}: none", 0.0, RIVAL_WARN, RIVAL_FAIL, "share")
    theirs = _inside(matches.errors_px(T), gate_px)
    degrees, centimetres = pose_difference(T, fit.T_camera_lidar[camera])
    near = degrees < RIVAL_APART_DEG and centimetres < RIVAL_APART_CM
    alone, lost = int((theirs & ~ours).sum()), int((ours & ~theirs).sum())
    share = 0.0 if near else alone / max(lost, 1)
    advice = f"the other is {degrees:.2g} deg, {centimetres:.2g} cm away; which one is right?"
    return above(name, share, RIVAL_WARN, RIVAL_FAIL, "share", advice)


def _inside(errors_and_valid: tuple[Array, NDArray[np.bool_]], gate_px: float) -> NDArray[np.bool_]:
    errors, valid = errors_and_valid
    return np.asarray(valid & (errors <= gate_px))
