"""The error model of a solution: ``calibgraph.graph.latent_poses`` filled with data, and fitted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.by_place import BlockByPlace, PairByPlace, place_of
from calibgraph.graph.latent_poses import LatentPoseModel, VarianceComponents
from calibgraph.graph.objective import join, pose_key
from calibgraph.model.error_components import UNKNOWN, error_components
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import invert, to_T_lidar_camera
from calibgraph.model.places import Places
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.camera_pairs import PairTerm, usual_excess
from calibgraph.solver.conflicts import relative_pose_conflict
from calibgraph.solver.elimination import LatentPoseFit, fit_latent_poses, start_values
from calibgraph.solver.objective import Objective, Scales
from calibgraph.solver.optimizer import Optimum
from calibgraph.solver.pair_refinement import pair_sigmas
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.solver.scan_distortion import (
    DistortionEvidence,
    distortion_evidence,
    pair_jacobians,
)
from calibgraph.solver.variance_components import VarianceRatios, estimate_variance_ratios
from calibgraph.solver.within_place import WEAK, WithinPlace, within_place

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_LEAST_SIGMA = 1e-5  # rad and m: as exact is what is stated to be so; less is lost in rounding
_ROUNDS = 3  # of fits and estimates of the variance ratios
_COARSE_TOLERANCE = 1e-4  # relative change of the cost, meanwhile


@dataclass(frozen=True, eq=False)
class ErrorFit:
    """The optimum of the error model.

    Attributes:
        fit: the optimum, with the variance ratios that fit the data.
        places: the frame numbers of each place.
        ratios: of its variance components.
        without_priors: the optimum without measured relative poses and priors, where some are
            measured.
    """

    fit: LatentPoseFit
    places: tuple[Numbers, ...]
    ratios: VarianceRatios
    without_priors: ErrorFit | None = None

    @property
    def model(self) -> LatentPoseModel:
        """The graph."""
        return self.fit.linear.model

    def with_shared_ratio(self, least: float) -> ErrorFit:
        """The same optimum; the covariances of what all places share have at least this ratio."""
        factor = least / self.ratios.shared
        if factor <= 1.0:
            return self
        parts = self.model.components
        components = replace(
            parts,
            cloud=factor * parts.cloud,
            camera=factor * parts.camera,
            distortion_size=factor * parts.distortion_size,
        )
        fit = self.fit.with_model(replace(self.model, components=components))
        return replace(self, fit=fit, ratios=replace(self.ratios, shared=least))

    def scan_distortion(self, prior_sigmas: Sequence[float]) -> tuple[Array, Array]:
        """(3,) offset of elevations [rad], their stretch, motion [m]; (3,) standard deviations.

        Args:
            prior_sigmas: (3,) prior standard deviations that the matcher states.
        """
        values, covariance = self.fit.distortion
        unit = np.asarray(prior_sigmas)
        return unit * values, unit * np.sqrt(np.diag(covariance))

    def drop_pose_graph(self) -> LatentPoseFit | None:
        """The optimum without priors and measured relative poses, of the same ratios."""
        model = replace(self.model, pose_graph=gtsam.NonlinearFactorGraph())
        return fit_latent_poses(model, self.fit, relative_tolerance=_COARSE_TOLERANCE)

    @property
    def T_camera_lidar(self) -> dict[str, Array]:
        """Per camera, (4, 4)."""
        return self.fit.T_camera_lidar


def refine_with_error_model(
    inliers: Objective,
    optimum: Optimum,
    scales: Scales,
    metadata: Mapping[str, Any],
    held: Sequence[str] = (),
) -> tuple[ErrorFit | None, Optimum]:
    """The optimum of the error model, where it differs from that of independent matches.

    With nothing but the matches of one place, and no scan distortion, both optima are equal; then
    no model is made. Measured relative poses that contradict the correspondences take no part, so
    that a wrong one, or two swapped cameras, do not move the others. Arguments and None as of
    :func:`fit_errors`.
    """
    several = inliers.blocks and len(places_of(inliers, metadata)) > 1
    distorted = any(MatcherFindings.from_metadata(metadata).bend_sigmas)
    if not (several or distorted or inliers.pairs or inliers.rig.relative_poses):
        return None, optimum
    free, T = None, optimum.T_camera_lidar
    if inliers.rig.relative_poses:
        free = fit_without_priors(inliers, T, scales, metadata)
    if free is not None:
        agreeing = _without_contradictions(inliers, free)
        T = T if agreeing is inliers else T | free.T_camera_lidar
        inliers = agreeing
    found = fit_errors(inliers, T, scales, metadata, held)
    if found is None:
        return None, optimum
    found = replace(found, without_priors=free)
    fit, T = found.fit, found.T_camera_lidar
    return found, Optimum(T, fit.cost, optimum.iterations + fit.iterations, fit.converged)


def fit_without_priors(
    inliers: Objective,
    T_camera_lidar: Mapping[str, Array],
    scales: Scales,
    metadata: Mapping[str, Any],
) -> ErrorFit | None:
    """The fit of correspondences and pairs alone; None as of :func:`fit_errors`."""
    if inliers.config.preset != "auto" or not inliers.uses_correspondences:
        return None
    free = inliers.data_only()
    start = {name: T_camera_lidar[name] for name in free.cameras}
    return fit_errors(free, free.minimize(start, scales).T_camera_lidar, scales, metadata)


def _without_contradictions(inliers: Objective, free: ErrorFit) -> Objective:
    """Without the relative poses that the correspondences of both their cameras contradict."""
    cameras, limit = free.model.cameras, error_components().contradiction_sigmas
    measured, T = inliers.rig.relative_poses, free.T_camera_lidar
    kept = tuple(
        pair
        for pair in measured
        if not {pair.a, pair.b} <= set(cameras)
        or relative_pose_conflict(pair, cameras, T, free.fit.covariance).largest <= limit
    )
    if len(kept) == len(measured):
        return inliers
    return replace(inliers, rig=inliers.rig.model_copy(update={"relative_poses": kept}))


def fit_errors(
    inliers: Objective,
    T_camera_lidar: Mapping[str, Array],
    scales: Scales,
    metadata: Mapping[str, Any],
    held: Sequence[str] = (),
) -> ErrorFit | None:
    """Fit poses and variance ratios, from the optimum for independent matches.

    Args:
        inliers: after the gate.
        T_camera_lidar: its optimum.
        scales: of the residuals.
        metadata: of the correspondences, with the matcher's error and the places.
        held: cameras that nothing determines; they are known to a radian and a metre.

    Returns:
        None without correspondences, with a preset of the paper, or where a direction of a camera
        is not determined.
    """
    if inliers.config.preset != "auto" or not inliers.uses_correspondences or not inliers.blocks:
        return None
    places = places_of(inliers, metadata)
    model = error_model(inliers, T_camera_lidar, scales, metadata, places, held)
    prior, ratios = model.components, VarianceRatios()
    fit = fit_latent_poses(
        model, start_values(model, T_camera_lidar), relative_tolerance=_COARSE_TOLERANCE
    )
    if fit is not None and np.isfinite(prior.robust_scale):  # an outlying place has no evidence
        weight = fit.place_weights(prior.robust_scale)
        prior = replace(prior, distortion_weight=weight[:, :1] * weight[:, 1:])
        model = replace(model, components=prior)
    for _ in range(_ROUNDS):
        found = ratios if fit is None else estimate_variance_ratios(fit, ratios)
        if fit is None or found.is_near(ratios):
            break
        model, ratios = replace(model, components=found.scale(prior)), found
        fit = fit_latent_poses(model, fit, relative_tolerance=_COARSE_TOLERANCE)
    fit = None if fit is None else fit_latent_poses(model, fit)
    return None if fit is None else ErrorFit(fit, tuple(places), ratios)


def places_of(inliers: Objective, metadata: Mapping[str, Any]) -> list[Numbers]:
    """The numbers of the frames of each place, over all cameras."""
    blocks = [block.frame_numbers for block in inliers.blocks.values()]
    frames = np.unique(np.concatenate([*blocks, *(pair.frame for pair in inliers.pairs)]))
    return Places.from_metadata(metadata).split(frames)


def error_model(
    inliers: Objective,
    T_camera_lidar: Mapping[str, Array],
    scales: Scales,
    metadata: Mapping[str, Any],
    places: Sequence[Numbers],
    held: Sequence[str] = (),
) -> LatentPoseModel:
    """The model with prior variance components; arguments as of :func:`fit_errors`."""
    findings, cameras = MatcherFindings.from_metadata(metadata), tuple(T_camera_lidar)
    blocks, shown = {}, {}
    for name, block in inliers.blocks.items():
        by_place = block_by_place(block, scales[name], places)
        within = within_place(inliers, name, T_camera_lidar[name], scales[name], by_place)
        blocks[name], evidence = by_place.with_variance(within.least), None
        if any(findings.bend_sigmas):
            pose = to_T_lidar_camera(T_camera_lidar[name])
            evidence = distortion_evidence(block, scales[name], pose, WEAK, places=places)
        shown[name] = within, evidence
    pairs = [pair for pair in inliers.pairs if len(pair.frame)]  # the gate may leave none
    components = variance_components(findings, cameras, shown, places=len(places))
    if not any(findings.systematic_sigmas) and inliers.pairs:  # nothing is stated
        unknown = error_components().matchers[UNKNOWN]
        whole = unknown.systematic_rotation_rad, unknown.systematic_translation_m
        components = _with_common_error(components, whole, unknown.camera_share)
    components = replace(
        components,
        pair_distortion_jacobian=pair_jacobians(
            components.distortion_jacobian,
            np.isin(cameras, list(inliers.blocks)),
            invert(np.stack([T_camera_lidar[name] for name in cameras])),
            sorted({(cameras.index(pair.a), cameras.index(pair.b)) for pair in pairs}),
        ),
    )
    graph = join(inliers.pose_graph, held_graph(cameras, T_camera_lidar, held))
    return LatentPoseModel(cameras, blocks, _pairs_by_place(pairs, places), graph, components)


def variance_components(
    findings: MatcherFindings,
    cameras: Sequence[str],
    shown: Mapping[str, tuple[WithinPlace, DistortionEvidence | None]],
    *,
    places: int,
) -> VarianceComponents:
    """The prior components, but for the pairs' part of the scan distortion.

    Args:
        findings: of the matcher, with the sizes of its errors.
        cameras: of the rig.
        shown: per camera that has correspondences, what these share by the scatter of frames, and
            their quadratics in the scan distortion.
        places: number of places.
    """
    prior, sigmas = error_components(), np.asarray(findings.bend_sigmas)
    at_place = np.tile(np.eye(6), (places, len(cameras), 1, 1))
    scatter_at_place, jacobian = at_place.copy(), np.zeros((len(cameras), 6, len(sigmas)))
    shape = places, len(cameras), len(sigmas)
    vector, information = np.zeros(shape), np.zeros((*shape, shape[2]))
    for name, (within, evidence) in shown.items():
        number = cameras.index(name)
        at_place[:, number] = within.at_place(findings.place_variance)
        scatter_at_place[:, number] = within.at_place(0.0)
        if evidence is not None:
            jacobian[number] = evidence.jacobian * sigmas
            weight = 1.0 / within.mean_variance(findings.place_variance)
            information[:, number] = weight * np.outer(sigmas, sigmas) * evidence.information
            vector[:, number] = weight * sigmas * evidence.vector
    of_place = np.square([findings.place_rotation_rad, findings.place_translation_m])
    components = VarianceComponents(
        cloud=np.eye(6),
        cloud_at_place=pose_covariance(*of_place),
        camera=np.eye(6),
        pairs=pose_covariance(*(pair_sigmas()[[0, 3]] ** 2 / 2)),
        at_place=at_place,
        scatter_at_place=scatter_at_place,
        distortion_jacobian=jacobian,
        pair_distortion_jacobian=np.zeros_like(jacobian),
        distortion_information=information,
        distortion_vector=vector,
        distortion_weight=np.ones(shape[:2]),
        robust_scale=prior.robust_sigmas if places >= prior.robust_places else np.inf,
    )
    return _with_common_error(components, findings.rigid_sigmas, findings.camera_share)


def _with_common_error(
    components: VarianceComponents, sigmas: tuple[float, float], camera_share: float
) -> VarianceComponents:
    """With a rigid error that all frames share, of the cloud and of each camera."""
    whole = np.square(sigmas)
    return replace(
        components,
        cloud=pose_covariance(*((1.0 - camera_share) * whole)),
        camera=pose_covariance(*(camera_share * whole)),
    )


def block_by_place(
    camera: CameraBlock, scale: ResidualScale, places: Sequence[Numbers]
) -> BlockByPlace:
    """The correspondences of a camera, sorted by place.

    Args:
        camera: its correspondences.
        scale: of their residuals.
        places: the frame numbers of each place.
    """
    of_frame, counts = place_of(camera.frame_numbers, places), camera.frame_counts
    if len(places) == 1:
        return BlockByPlace(camera.with_scale(scale), np.array([0, len(camera)]), of_frame, counts)
    edges = np.zeros(len(places) + 1, dtype=np.int64)
    np.add.at(edges[1:], of_frame, counts)
    block = camera.sorted_by(of_frame).with_scale(scale)
    return BlockByPlace(block, edges.cumsum(), of_frame, counts)


def pose_covariance(rotation_rad2: float, translation_m2: float) -> Array:
    """(6, 6), positive definite, from the variance per axis."""
    return np.diag(np.maximum(np.repeat([rotation_rad2, translation_m2], 3), _LEAST_SIGMA**2))


def held_graph(
    cameras: Sequence[str], T_camera_lidar: Mapping[str, Array], held: Sequence[str]
) -> gtsam.NonlinearFactorGraph:
    """Priors of some cameras, to a radian and a metre."""
    graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(6)
    for name in held:
        pose = to_T_lidar_camera(T_camera_lidar[name])
        graph.add(gtsam.PriorFactorPose3(pose_key(cameras, name), pose, unit))
    return graph


def _pairs_by_place(pairs: Sequence[PairTerm], places: Sequence[Numbers]) -> list[PairByPlace]:
    """Each term with the information of features that err as usual in a frame."""
    found = []
    for pair in pairs:
        own = [one for one in pairs if {one.a, one.b} == {pair.a, pair.b}]
        term = pair.deflate(usual_excess(own))
        of_row = place_of(term.frame, places)
        rows = np.argsort(of_row, kind="stable")
        present, first = np.unique(of_row[rows], return_index=True)
        edges = np.append(first, len(rows))
        found.append(PairByPlace(term.a, term.b, term.block.select(rows), present, edges))
    return found
