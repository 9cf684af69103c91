"""What a solution is worth: its covariance, what it was tested against, the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.calibration import Residuals
from calibgraph.model.geometry import (
    invert,
    pose_difference,
    relative_covariance,
    relative_transform,
)
from calibgraph.model.rig import RelativePose, Rig
from calibgraph.model.verdict import Check, Verdict, above
from calibgraph.solver.covariance import cluster_robust_covariance, data_sigmas
from calibgraph.solver.factor_graph import relative_pose_graph
from calibgraph.solver.objective import Objective, Scales, Transforms
from calibgraph.solver.solution import Solution
from calibgraph.trust.bootstrap import bootstrap_check, bootstrap_covariance
from calibgraph.trust.cross_validation import (
    competing_solution_check,
    even_frames,
    halves_of,
    held_out_check,
    restart_checks,
)
from calibgraph.trust.guess import guess_checks, points_check, swap_check
from calibgraph.trust.intrinsics import smell_checks
from calibgraph.trust.observability import prior_shares, weaknesses
from calibgraph.trust.solution_checks import (
    Conflict,
    Evidence,
    assumed_spread_check,
    camera_verdict,
    findings_of_camera,
    with_matching,
)
from factors import pose_sigmas

Array = NDArray[np.float64]

Alone = tuple[Transforms, Array | None]
"""Transforms without priors and relative poses, and their (6 M, 6 M) covariance."""

PULLED_SIGMAS = 4.0
APART_WARN, APART_FAIL = 0.35, 0.9
PRIOR_WARN = 0.5
"""Share of a result above which it says more of the priors than of the data."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """How good a solution is.

    Attributes:
        covariance: per camera, (6, 6) or None.
        joint_covariance: (6 N, 6 N) or None.
        bootstrap: per camera (6, 6), if it was asked for.
        residuals: per camera, of all correspondences, not only the inliers.
        weaknesses: per camera, in words.
        prior_share: per camera, of its result.
        verdicts: per camera.
    """

    covariance: dict[str, Array | None]
    joint_covariance: Array | None
    bootstrap: dict[str, Array]
    residuals: dict[str, Residuals]
    weaknesses: dict[str, tuple[str, ...]]
    prior_share: dict[str, float]
    verdicts: dict[str, Verdict]


def assess(fit: Solution, guess: Rig) -> Assessment:
    """Judge a solution by everything that its correspondences can tell.

    Args:
        fit: the solution.
        guess: the rig as it was guessed.
    """
    matches, poses = fit.objective.blocks, fit.T_camera_lidar
    residuals = {name: m.at(poses[name]).summary(fit.scales[name]) for name, m in matches.items()}
    scatter = scatter_covariance(fit.inliers, poses, fit.scales)
    joint = (
        None
        if scatter is None
        else scatter + _shared(fit.correspondences.findings.systematic_sigmas, len(poses))
    )
    covariance = {name: _block(joint, place) for place, name in enumerate(poses)}
    scattered = {name: _block(scatter, place) for place, name in enumerate(poses)}
    bootstrap = bootstrap_covariance(fit)
    shares = prior_shares(fit)
    evidence = _evidence(fit, residuals, covariance)
    restarts = restart_checks(fit)
    verdicts = {}
    for name, camera in fit.rig.cameras.items():
        said = findings_of_camera(fit.correspondences.findings, name)
        if joint is None:
            said = replace(said, systematic_sigmas=fit.correspondences.findings.systematic_sigmas)
        verdict = camera_verdict(camera, evidence[name]).and_first(_causes(fit, guess, name))
        verdict = with_matching(verdict, said)
        verdicts[name] = verdict.and_also(
            [
                *_trials(fit, name, evidence[name]),
                *restarts.get(name, ()),
                *bootstrap_check(scattered[name], bootstrap.get(name)),
                above("share of the priors in the result", shares[name], PRIOR_WARN, 1.0, "share"),
            ]
        )
    return Assessment(
        covariance=covariance,
        joint_covariance=joint,
        bootstrap=bootstrap,
        residuals=residuals,
        weaknesses={name: weaknesses(fit, name, scattered[name]) for name in poses},
        prior_share=shares,
        verdicts=verdicts,
    )


def _block(joint: Array | None, place: int) -> Array | None:
    return None if joint is None else joint[6 * place : 6 * place + 6, 6 * place : 6 * place + 6]


def _shared(systematic_sigmas: tuple[float, float], cameras: int) -> Array:
    """(6 N, 6 N) covariance of the error that the matcher says its frames share."""
    rotation, translation = systematic_sigmas
    sigmas = pose_sigmas(rotation_rad=rotation, translation_m=translation)
    return np.diag(np.tile(sigmas**2, cameras))


def scatter_covariance(inliers: Objective, poses: Transforms, scales: Scales) -> Array | None:
    """(6 N, 6 N); None where the terms do not use the correspondences, or frames are too few."""
    if not inliers.uses_correspondences:
        return None
    return cluster_robust_covariance(
        {name: m.with_scale(scales[name]) for name, m in inliers.blocks.items()},
        {name: m.frame for name, m in inliers.blocks.items()},
        inliers.pose_graph,
        poses,
        gate_hessian=inliers.gate_hessian,
    )


def _evidence(
    fit: Solution, residuals: Mapping[str, Residuals], covariance: Mapping[str, Array | None]
) -> dict[str, Evidence]:
    """Per camera what its verdict is made of."""
    alone = _alone(fit)
    conflicts = _conflicts(fit, alone)
    halves = halves_of(fit)
    at_best = _data_sigmas(fit)
    evidence = {}
    for place, name in enumerate(fit.rig.cameras):
        matches = fit.inliers.blocks.get(name)
        evidence[name] = Evidence(
            residuals=residuals.get(name),
            used=0 if matches is None else len(matches.frame),
            frames=0 if matches is None else len(np.unique(matches.frame)),
            covariance=covariance[name],
            data_sigmas=None if at_best is None else at_best[place],
            halves=halves.get(name),
            conflicts=tuple(c for c in conflicts if name in (c.pair.a, c.pair.b)),
            pulled=_pulled(fit, alone, name),
            converged=fit.optimum.converged,
            terms=fit.terms,
        )
    return evidence


def _data_sigmas(fit: Solution) -> Array | None:
    """(N, 6) what correspondences and measured relative poses could tell at best."""
    if not fit.inliers.uses_correspondences:
        return None
    blocks = {name: m.with_scale(fit.scales[name]) for name, m in fit.inliers.blocks.items()}
    known = relative_pose_graph(fit.inliers.cameras, fit.rig.relative_poses)
    return data_sigmas(blocks, known, fit.T_camera_lidar)


def _conflicts(fit: Solution, alone: Alone | None) -> list[Conflict]:
    """How the rig's relative poses fit what the correspondences alone say.

    Asked of pairs in which both cameras have correspondences.
    """
    if alone is None:
        return []
    named, (poses, covariance) = tuple(fit.inliers.blocks), alone
    pairs = [p for p in fit.rig.relative_poses if p.a in named and p.b in named]
    return [relative_pose_conflict(pair, named, poses, covariance) for pair in pairs]


def _pulled(fit: Solution, alone: Alone | None, camera: str) -> tuple[float, float] | None:
    """How far priors and relative poses pull a camera from its own solution: deg, cm.

    None where they do not, or within what that solution leaves open.
    """
    if alone is None or camera not in fit.inliers.blocks:
        return None
    poses, covariance = alone
    if covariance is not None:
        place = 6 * tuple(fit.inliers.blocks).index(camera)
        sigmas = np.sqrt(np.diag(covariance))[place : place + 6]
        step = gtsam.Pose3(relative_transform(fit.T_camera_lidar[camera], poses[camera]))
        if np.abs(gtsam.Pose3.Logmap(step) / sigmas).max() < PULLED_SIGMAS:
            return None
    return pose_difference(fit.T_camera_lidar[camera], poses[camera])


def _alone(fit: Solution) -> Alone | None:
    """What the correspondences alone say: every camera for itself, and their covariance.

    None where nothing else has a say.
    """
    if not fit.inliers.uses_correspondences or not fit.inliers.pose_graph.size():
        return None
    free = fit.inliers.data_only()
    alone = free.minimize({name: fit.T_camera_lidar[name] for name in free.cameras}, fit.scales)
    scatter = scatter_covariance(free, alone.T_camera_lidar, fit.scales)
    shared = _shared(fit.correspondences.findings.systematic_sigmas, len(free.cameras))
    return alone.T_camera_lidar, None if scatter is None else scatter + shared


def relative_pose_conflict(
    pair: RelativePose, cameras: tuple[str, ...], T: Mapping[str, Array], covariance: Array | None
) -> Conflict:
    """The difference of a relative pose from an estimate, and the sigma expected of it."""
    estimated = relative_transform(T[pair.a], T[pair.b])
    difference = gtsam.Pose3.Logmap(gtsam.Pose3(invert(pair.T_a_b) @ estimated))
    variance = (
        pose_sigmas(rotation_rad=pair.rotation_sigma_rad, translation_m=pair.translation_sigma_m)
        ** 2
    )
    if covariance is not None:
        places = cameras.index(pair.a), cameras.index(pair.b)
        of_pair = relative_covariance(covariance, *places, invert(estimated))
        variance = variance + np.diag(of_pair)
    return Conflict(pair, difference, np.sqrt(variance))


def _causes(fit: Solution, guess: Rig, camera: str) -> list[Check]:
    """What names a cause comes first: a guess meant otherwise, swapped cameras, points in mm."""
    matches = fit.objective.blocks.get(camera)
    checks = guess_checks(
        guess.T_camera_lidar[camera], fit.T_camera_lidar[camera], fit.correspondences.findings
    )
    checks += swap_check(camera, guess.T_camera_lidar, fit.T_camera_lidar)
    return checks if matches is None else [*checks, points_check(matches)]


def _apart_check(counts: Mapping[str, int]) -> Check:
    return above(
        "frames apart from where they are densest",
        counts["outlier_frames"] / max(1, counts["frames"]),
        APART_WARN,
        APART_FAIL,
        "share",
        "few frames decide against many; check what differs between them",
    )


def _trials(fit: Solution, name: str, evidence: Evidence) -> list[Check]:
    """What is asked of a camera's result beyond its own residuals."""
    matches, T = fit.objective.blocks.get(name), fit.T_camera_lidar[name]
    camera = fit.rig.cameras[name]
    if matches is None or not fit.objective.uses_correspondences:
        return []
    checks = [competing_solution_check(fit, name), _apart_check(fit.counts[name])]
    if fit.config.loss_scale_px is not None and evidence.residuals is not None:
        checks.append(assumed_spread_check(evidence.residuals, fit.config.loss_scale_px))
    if evidence.halves is not None:
        checks.append(held_out_check(matches, evidence.halves, even_frames(fit.inliers)))
    return [*checks, *smell_checks(camera, matches, fit.scales[name], T)]
