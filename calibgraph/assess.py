"""What a solution is worth: its covariance, the agreement of halves of the data, the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.calibration import Residuals, Verdict
from calibgraph.covariance import cluster_robust_covariance
from calibgraph.graph import Optimum
from calibgraph.matches import MIN_MATCHES
from calibgraph.problem import Problem, Scales
from calibgraph.rig import Rig
from calibgraph.verdict import Evidence, camera_verdict
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
    joint = _joint_covariance(inliers, solution, scales)
    if joint is not None:
        rotation, translation = systematic_sigmas
        sigmas = pose_sigmas(rotation_rad=rotation, translation_m=translation)
        joint = joint + np.diag(np.tile(sigmas**2, len(rig.cameras)))
    halves = _halves(inliers, solution, scales)
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
            halves=halves.get(name),
            converged=solution.converged,
            terms=inliers.terms,
        )
        verdicts[name] = camera_verdict(camera, evidence)
    return Assessment(covariance, joint, verdicts)


def _joint_covariance(inliers: Problem, solution: Optimum, scales: Scales) -> Array | None:
    """(6 N, 6 N); None where the terms do not use the correspondences."""
    if not inliers.fits_matches:
        return None
    blocks = {name: m.scaled(scales[name]) for name, m in inliers.matches.items()}
    frames = {name: m.frame for name, m in inliers.matches.items()}
    return cluster_robust_covariance(blocks, frames, inliers.pose_graph, solution.T_camera_lidar)


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
