"""What a solution is worth: its covariance, the agreement of halves of the data, the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.calibration import Residuals, Verdict
from calibgraph.covariance import cluster_robust_covariance, data_sigmas
from calibgraph.graph import Optimum, relative_pose_graph
from calibgraph.matches import MIN_MATCHES
from calibgraph.problem import Problem, Scales
from calibgraph.rig import RelativePose, Rig, angle_deg
from calibgraph.verdict import Conflict, Evidence, camera_verdict
from factors import pose_sigmas

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Assessment:
    """How good a solution is.

    Attributes:
        covariance: per camera, (6, 6) or None.
        joint_covariance: (6 N, 6 N) or None.
        verdicts: per camera.
    """

    covariance: dict[str, Array | None]
    joint_covariance: Array | None
    verdicts: dict[str, Verdict]


def assess(
    rig: Rig,
    inliers: Problem,
    solution: Optimum,
    scales: Scales,
    *,
    residuals: Mapping[str, Residuals],
    systematic_sigmas: tuple[float, float],
) -> Assessment:
    """Judge a solution.

    Args:
        rig: lenses.
        inliers: what the solution was fitted to.
        solution: the poses.
        scales: of the residuals.
        residuals: of all correspondences, not only the inliers.
        systematic_sigmas: rotation [rad] and translation [m] that all frames share, per axis: the
            scatter between frames, which the covariance is made of, cannot show them.
    """
    joint = _joint_covariance(inliers, solution, scales, systematic_sigmas)
    conflicts = _conflicts(rig, inliers, solution, scales, systematic_sigmas)
    halves = _halves(inliers, solution, scales)
    at_best = _data_sigmas(rig, inliers, solution, scales)
    covariance: dict[str, Array | None] = {}
    verdicts = {}
    for index, (name, camera) in enumerate(rig.cameras.items()):
        rows = slice(6 * index, 6 * index + 6)
        covariance[name] = None if joint is None else joint[rows, rows]
        matches = inliers.matches.get(name)
        evidence = Evidence(
            residuals=residuals.get(name),
            used=0 if matches is None else len(matches.frame),
            frames=0 if matches is None else len(np.unique(matches.frame)),
            covariance=covariance[name],
            data_sigmas=None if at_best is None else at_best[index],
            halves=halves.get(name),
            conflicts=tuple(c for c in conflicts if name in (c.pair.a, c.pair.b)),
            turned_deg=_angle_between(camera.T_camera_lidar, solution.T_camera_lidar[name]),
            converged=solution.converged,
            terms=inliers.terms,
        )
        verdicts[name] = camera_verdict(camera, evidence)
    return Assessment(covariance, joint, verdicts)


def _angle_between(one: Array, two: Array) -> float:
    return angle_deg(one[:3, :3] @ two[:3, :3].T)


def _joint_covariance(
    inliers: Problem, solution: Optimum, scales: Scales, systematic_sigmas: tuple[float, float]
) -> Array | None:
    """(6 N, 6 N); None where the terms do not use the correspondences, or frames are too few."""
    if not inliers.fits_matches:
        return None
    blocks = {name: m.scaled(scales[name]) for name, m in inliers.matches.items()}
    frames = {name: m.frame for name, m in inliers.matches.items()}
    scatter = cluster_robust_covariance(
        blocks,
        frames,
        inliers.pose_graph,
        solution.T_camera_lidar,
        gate_hessian=inliers.gate_hessian,
    )
    if scatter is None:
        return None
    rotation, translation = systematic_sigmas
    sigmas = pose_sigmas(rotation_rad=rotation, translation_m=translation)
    return scatter + np.diag(np.tile(sigmas**2, len(solution.T_camera_lidar)))


def _data_sigmas(rig: Rig, inliers: Problem, solution: Optimum, scales: Scales) -> Array | None:
    """(N, 6) what correspondences and measured relative poses could tell at best."""
    if not inliers.fits_matches:
        return None
    blocks = {name: m.scaled(scales[name]) for name, m in inliers.matches.items()}
    known = relative_pose_graph(inliers.cameras, rig.relative_poses)
    return data_sigmas(blocks, known, solution.T_camera_lidar)


def _conflicts(
    rig: Rig,
    inliers: Problem,
    solution: Optimum,
    scales: Scales,
    systematic_sigmas: tuple[float, float],
) -> list[Conflict]:
    """How the rig's relative poses fit what the correspondences alone say.

    Asked of pairs in which both cameras have correspondences, by a solve without relative poses.
    """
    pairs = [p for p in rig.relative_poses if p.a in inliers.matches and p.b in inliers.matches]
    if not pairs or not inliers.fits_matches:
        return []
    cameras = tuple(inliers.matches)
    free = replace(inliers, cameras=cameras, pose_graph=gtsam.NonlinearFactorGraph())
    start = {name: solution.T_camera_lidar[name] for name in cameras}
    alone = free.minimize(start, scales)
    covariance = _joint_covariance(free, alone, scales, systematic_sigmas)
    found = alone.T_camera_lidar
    return [relative_pose_conflict(pair, cameras, found, covariance) for pair in pairs]


def relative_pose_conflict(
    pair: RelativePose, cameras: tuple[str, ...], T: Mapping[str, Array], covariance: Array | None
) -> Conflict:
    """The difference of a relative pose from an estimate, and the sigma expected of it."""
    estimated = T[pair.a] @ np.linalg.inv(T[pair.b])
    difference = gtsam.Pose3.Logmap(gtsam.Pose3(np.linalg.inv(pair.T_a_b) @ estimated))
    variance = (
        pose_sigmas(rotation_rad=pair.rotation_sigma_rad, translation_m=pair.translation_sigma_m)
        ** 2
    )
    if covariance is not None:
        # T_a_b = exp(xi_a) T_a (exp(xi_b) T_b)^-1: in b, the difference is Ad(T_b_a) xi_a - xi_b.
        i, j = 6 * cameras.index(pair.a), 6 * cameras.index(pair.b)
        by_poses = np.zeros((6, len(covariance)))
        by_poses[:, i : i + 6] = gtsam.Pose3(np.linalg.inv(estimated)).AdjointMap()
        by_poses[:, j : j + 6] -= np.eye(6)
        variance = variance + np.diag(by_poses @ covariance @ by_poses.T)
    return Conflict(pair, difference, np.sqrt(variance))


def _halves(inliers: Problem, solution: Optimum, scales: Scales) -> dict[str, tuple[Array, Array]]:
    """Per camera the solutions from every other frame and from the frames between, if possible."""
    if not inliers.fits_matches:
        return {}
    numbers = np.unique(np.concatenate([m.frame for m in inliers.matches.values()]))
    solutions = []
    for half in (numbers[::2], numbers[1::2]):
        part = {n: m.select(np.isin(m.frame, half)) for n, m in inliers.matches.items()}
        if any(len(m.frame) < MIN_MATCHES for m in part.values()):
            return {}
        problem = inliers.with_matches(part)
        solutions.append(problem.minimize(solution.T_camera_lidar, scales).T_camera_lidar)
    return {name: (solutions[0][name], solutions[1][name]) for name in inliers.matches}
