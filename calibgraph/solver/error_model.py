"""The error model of a solution: ``calibgraph.graph.latent_poses`` filled with data, and fitted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.components import VarianceRatios
from calibgraph.graph.latent_poses import BlockByPlace, LatentPoseModel
from calibgraph.graph.objective import join, pose_key
from calibgraph.model.findings import UNKNOWN, MatcherFindings, error_components
from calibgraph.model.geometry import (
    invert,
    relative_covariance,
    relative_transform,
    to_T_lidar_camera,
)
from calibgraph.model.places import Places
from calibgraph.model.rig import RelativePose
from calibgraph.solver.columns import distortion_evidence, pair_jacobians
from calibgraph.solver.components import common_error, estimate_variance_ratios, variance_components
from calibgraph.solver.covariance import FittedObjective
from calibgraph.solver.lens import lens_errors, lens_term, weak_information
from calibgraph.solver.places import ErrorFit, fit_latent_poses, start_values
from calibgraph.solver.two_pass import Objective, Optimum
from calibgraph.solver.within_place import block_by_place, pairs_by_place, within_place
from factors import pose_sigmas


@dataclass(frozen=True, eq=False)
class Conflict:
    """The difference of a measured relative pose from the correspondences' estimate of it.

    Attributes:
        pair: the relative pose of the rig file.
        difference: (6,) tangent from measured to estimated T_a_b: rotation [rad], translation [m],
            along the axes of b.
        sigmas: (6,) standard deviations expected of it: the measurement's and the estimate's.
    """

    pair: RelativePose
    difference: Array
    sigmas: Array

    @property
    def largest(self) -> float:
        """The largest component of the difference, in its standard deviations."""
        return float(np.abs(self.difference / self.sigmas).max())


def relative_pose_conflict(
    pair: RelativePose,
    cameras: tuple[str, ...],
    T_camera_lidar: Mapping[str, Array],
    covariance: Array,
) -> Conflict:
    """The difference of a relative pose from an estimate, and the sigma expected of it.

    Args:
        pair: the measured relative pose.
        cameras: names in the order of the covariance.
        T_camera_lidar: per camera, (4, 4) from the correspondences alone.
        covariance: (6 N, 6 N) of these.
    """
    estimated = relative_transform(T_camera_lidar[pair.a], T_camera_lidar[pair.b])
    difference = gtsam.Pose3.Logmap(gtsam.Pose3(invert(pair.T_a_b) @ estimated))
    sigmas = pair.rotation_sigma_rad, pair.translation_sigma_m
    own = pose_sigmas(rotation_rad=sigmas[0], translation_m=sigmas[1]) ** 2
    places = cameras.index(pair.a), cameras.index(pair.b)
    of_pair = np.diag(relative_covariance(covariance, *places, invert(estimated)))
    # Where priors were taken out of what the data leave open, rounding may leave less than none.
    return Conflict(pair, difference, np.sqrt(own + np.maximum(of_pair, 0.0)))


Numbers = NDArray[np.int64]

_ROUNDS = 3  # of fits and estimates of the variance ratios


def refine_with_error_model(
    at: FittedObjective, optimum: Optimum, findings: MatcherFindings, places: Places
) -> tuple[ErrorFit | None, Optimum]:
    """The optimum of the error model, where it differs from that of independent matches.

    With nothing but the matches of one place, and no scan distortion, both optima are equal; then
    no model is made, nor with the paper's presets, whose estimate is the minimum of Eq. 5. Measured
    relative poses that contradict the correspondences take no part, so that a wrong one, or two
    swapped cameras, do not move the others.

    Args:
        at: the optimum for independent matches.
        optimum: the same, with its cost.
        findings: the matcher's error.
        places: which frames share a place.

    Returns:
        The model, None as of :func:`fit_errors`; and its optimum.
    """
    inliers = at.objective
    several = inliers.blocks and len(split_frames(inliers, places)) > 1
    distorted = any(findings.bend_sigmas)
    known = inliers.rig.relative_poses, inliers.lenses
    is_paper = inliers.config.preset != "auto"
    if is_paper or not (several or distorted or inliers.pairs or any(known)):
        return None, optimum
    free = fit_without_priors(at, findings, places) if inliers.rig.relative_poses else None
    if free is not None:
        agreeing = _without_contradictions(inliers, free)
        if agreeing is not inliers:
            at = replace(
                at, objective=agreeing, T_camera_lidar=at.T_camera_lidar | free.T_camera_lidar
            )
    found = fit_errors(at, findings, places)
    if found is None:
        return None, optimum
    found = replace(found, without_priors=free)
    return found, Optimum(found.T_camera_lidar, found.cost, found.converged)


def fit_without_priors(
    at: FittedObjective, findings: MatcherFindings, places: Places
) -> ErrorFit | None:
    """The fit of correspondences and pairs alone; None as of :func:`fit_errors`."""
    if not at.objective.uses_correspondences:
        return None
    return fit_errors(at.data_only(), findings, places)


def _without_contradictions(inliers: Objective, free: ErrorFit) -> Objective:
    """Without the relative poses that the correspondences of both their cameras contradict."""
    cameras, limit = free.model.cameras, error_components().contradiction_sigmas
    measured, mount = inliers.rig.relative_poses, free.of_mount
    T = mount.T_camera_lidar
    kept = tuple(
        pair
        for pair in measured
        if not {pair.a, pair.b} <= set(cameras)
        or relative_pose_conflict(pair, cameras, T, mount.covariance).largest <= limit
    )
    if len(kept) == len(measured):
        return inliers
    return replace(inliers, rig=inliers.rig.model_copy(update={"relative_poses": kept}))


def fit_errors(at: FittedObjective, findings: MatcherFindings, places: Places) -> ErrorFit | None:
    """Fit poses and variance ratios, from the optimum for independent matches.

    Args:
        at: that optimum.
        findings: the matcher's error.
        places: which frames share a place.

    Returns:
        None without correspondences, or where a direction of a camera is not determined.
    """
    inliers = at.objective
    if not inliers.uses_correspondences or not inliers.blocks:
        return None
    frames = split_frames(inliers, places)
    model = error_model(at, findings, frames)
    prior, ratios, linear = (
        model.components,
        VarianceRatios(),
        start_values(model, at.T_camera_lidar),
    )
    fit = fit_latent_poses(model, linear)
    for _ in range(_ROUNDS):
        found = ratios if fit is None else estimate_variance_ratios(fit.linear, ratios)
        if fit is None or found.is_near(ratios):
            break
        model, ratios = replace(model, components=found.scale(prior)), found
        fit = fit_latent_poses(model, fit.linear)
    return replace(fit, ratios=ratios) if fit and fit.linear.is_determined() else None


def split_frames(inliers: Objective, places: Places) -> list[Numbers]:
    """The numbers of the frames of each place, over all cameras."""
    blocks = [block.frame_numbers for block in inliers.blocks.values()]
    frames = np.unique(np.concatenate([*blocks, *(pair.frame for pair in inliers.pairs)]))
    return places.split(frames)


def error_model(
    at: FittedObjective, findings: MatcherFindings, places: Sequence[Numbers]
) -> LatentPoseModel:
    """The model with prior variance components.

    Args:
        at: the optimum for independent matches.
        findings: the matcher's error.
        places: the frame numbers of each place.
    """
    inliers, cameras = at.objective, at.cameras
    blocks: dict[str, BlockByPlace] = {}
    shown, lenses = {}, {}
    for name, block in inliers.blocks.items():
        placed, T = block_by_place(block, at.scales[name], places), at.T_camera_lidar[name]
        within, lens, evidence = within_place(at, name, placed), inliers.lenses.get(name), None
        if any(findings.bend_sigmas):
            weak = weak_information(lens)
            evidence = distortion_evidence(
                block, at.scales[name], T, weak, places=places, lens=lens
            )
        shown[name] = within, evidence
        left, free = placed.block.with_variance(within.least), None if lens is None else lens.free
        blocks[name] = replace(placed, block=left, free=free)
        if lens is not None:
            lenses[cameras.index(name)] = lens_term(
                lens, placed, within, T, evidence=evidence, findings=findings
            )
    pairs = [pair for pair in inliers.pairs if len(pair.frame)]  # the gate may leave none
    rigid = common_error(findings.rigid_sigmas, findings.camera_share)
    if not any(findings.systematic_sigmas) and inliers.pairs:  # nothing is stated
        unknown = MatcherFindings(**error_components().matchers[UNKNOWN])
        rigid = common_error(unknown.systematic_sigmas, unknown.camera_share)
    components = variance_components(findings, cameras, shown, places=len(places), rigid=rigid)
    features = pairs_by_place(pairs, places, cameras)
    components = replace(
        components,
        pair_distortion_jacobian=pair_jacobians(
            components.distortion_jacobian,
            np.isin(cameras, list(inliers.blocks)),
            invert(np.stack([*at.T_camera_lidar.values()])),
            sorted({pair.numbers for pair in features}),
        ),
    )
    graph = join(inliers.pose_graph, held_graph(cameras, at.T_camera_lidar, at.held))
    of, errors = inliers.config.of, lens_errors(at)
    return LatentPoseModel(
        cameras, blocks, features, graph, components, of, lenses, errors, tuple(places)
    )


def held_graph(
    cameras: Sequence[str], T_camera_lidar: Mapping[str, Array], held: Iterable[str]
) -> gtsam.NonlinearFactorGraph:
    """Priors of some cameras, to a radian and a metre."""
    graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(6)
    for name in held:
        pose = to_T_lidar_camera(T_camera_lidar[name])
        graph.add(gtsam.PriorFactorPose3(pose_key(cameras, name), pose, unit))
    return graph
