"""The error model of a solution: ``calibgraph.solver.hierarchy`` filled in, fitted, and sized."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.error_components import UNKNOWN, error_components
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import invert, to_T_lidar_camera
from calibgraph.model.places import Places
from calibgraph.solver.camera_pairs import PairTerm, usual_excess
from calibgraph.solver.cloud_bends import bend_evidence, shifts_of_pairs
from calibgraph.solver.component_sizes import Sizes, sizes_of
from calibgraph.solver.conflicts import relative_pose_conflict
from calibgraph.solver.factor_graph import Optimum, join, pose_key
from calibgraph.solver.hierarchy import Components, Hierarchy, PlacedBlock, PlacedPair
from calibgraph.solver.hierarchy_fit import HierarchyFit, bends_of, fit_hierarchy, linearize
from calibgraph.solver.hierarchy_poses import start_poses
from calibgraph.solver.objective import Objective, Scales
from calibgraph.solver.pair_refinement import pair_sigmas
from calibgraph.solver.within_place import WEAK, within_place

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_LEAST_SIGMA = 1e-5  # rad and m: as exact is what is stated to be so; less is lost in rounding
_ROUNDS = 3  # of fitting and sizing
_COARSE_TOLERANCE = 1e-4  # relative change of the cost, meanwhile


@dataclass(frozen=True, eq=False)
class ErrorFit:
    """The error model of a solution, at its minimum.

    Attributes:
        model: with the sizes that fit the data.
        fit: its minimum and marginals.
        places: the numbers of the frames of each place.
        sizes: of its components, over the usual ones.
        alone: the same without measured relative poses and priors, where some are measured.
    """

    model: Hierarchy
    fit: HierarchyFit
    places: tuple[Numbers, ...]
    sizes: Sizes
    alone: ErrorFit | None = None

    def with_shared_size(self, least: float) -> ErrorFit:
        """The same minimum, with covariances of what is shared everywhere of at least this size."""
        ratio = least / self.sizes.shared
        if ratio <= 1.0:
            return self
        parts = self.model.components
        model = replace(
            self.model,
            components=replace(
                parts,
                cloud=ratio * parts.cloud,
                camera=ratio * parts.camera,
                bend_size=ratio * parts.bend_size,
            ),
        )
        fit = linearize(model, self.fit)
        return replace(self, model=model, fit=fit, sizes=replace(self.sizes, shared=least))

    def bends(self, usual: Sequence[float]) -> tuple[Array, Array]:
        """(3,) offset of elevations [rad], their stretch, motion [m]; (3,) standard deviations.

        Args:
            usual: the standard deviations that the matcher states.
        """
        values, covariance = bends_of(self.model, self.fit)
        unit = np.asarray(usual)
        return unit * values, unit * np.sqrt(np.diag(covariance))

    def without_pose_graph(self) -> HierarchyFit | None:
        """The fit without priors and measured relative poses, of the same sizes."""
        model = replace(self.model, pose_graph=gtsam.NonlinearFactorGraph())
        return fit_hierarchy(model, self.fit, relative_tolerance=_COARSE_TOLERANCE)

    @property
    def T_camera_lidar(self) -> dict[str, Array]:
        """Per camera, (4, 4)."""
        return self.fit.T_camera_lidar(self.model)


def weigh_errors(
    inliers: Objective,
    optimum: Optimum,
    scales: Scales,
    metadata: Mapping[str, Any],
    held: Sequence[str] = (),
) -> tuple[ErrorFit | None, Optimum]:
    """The minimum under the error model, where it differs from that of independent matches.

    Where there is nothing but the matches of one place, and no bends, their minimum is that of
    both; it stays, and no model is made. Measured relative poses that contradict the
    correspondences take no part, so that one that is wrong, or two cameras that are swapped, do not
    move the others. Arguments and what is None as of :func:`fit_errors`.
    """
    several = inliers.blocks and len(places_of(inliers, metadata)) > 1
    bent = any(MatcherFindings.from_metadata(metadata).bend_sigmas)
    if not (several or bent or inliers.pairs or inliers.rig.relative_poses):
        return None, optimum
    alone, T = None, optimum.T_camera_lidar
    if inliers.rig.relative_poses:
        alone = fit_alone(inliers, T, scales, metadata)
    if alone is not None:
        agreeing = _without_contradictions(inliers, alone)
        T = T if agreeing is inliers else T | alone.T_camera_lidar
        inliers = agreeing
    found = fit_errors(inliers, T, scales, metadata, held)
    if found is None:
        return None, optimum
    found = replace(found, alone=alone)
    fit, T = found.fit, found.T_camera_lidar
    return found, Optimum(T, fit.cost, optimum.iterations + fit.iterations, fit.converged)


def fit_alone(
    inliers: Objective,
    T_camera_lidar: Mapping[str, Array],
    scales: Scales,
    metadata: Mapping[str, Any],
) -> ErrorFit | None:
    """The fit of the correspondences and pairs alone; what is None as of :func:`fit_errors`."""
    if inliers.config.preset != "auto" or not inliers.uses_correspondences:
        return None
    free = inliers.data_only()
    start = {name: T_camera_lidar[name] for name in free.cameras}
    return fit_errors(free, free.minimize(start, scales).T_camera_lidar, scales, metadata)


def _without_contradictions(inliers: Objective, alone: ErrorFit) -> Objective:
    """Without the relative poses that the correspondences of both their cameras contradict."""
    cameras, limit = alone.model.cameras, error_components().contradiction_sigmas
    measured, T = inliers.rig.relative_poses, alone.T_camera_lidar
    kept = tuple(
        pair
        for pair in measured
        if not {pair.a, pair.b} <= set(cameras)
        or relative_pose_conflict(pair, cameras, T, alone.fit.covariance).largest <= limit
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
    """Fit poses and sizes of the errors, from the minimum for independent matches.

    Args:
        inliers: after the gate.
        T_camera_lidar: its minimum.
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
    usual, sizes = model.components, Sizes()
    fit = fit_hierarchy(
        model, start_poses(model, T_camera_lidar), relative_tolerance=_COARSE_TOLERANCE
    )
    if fit is not None and np.isfinite(usual.robust_scale):  # what a wrong place shows, it errs in
        usual = replace(usual, bend_weight=fit.place_weights(usual.robust_scale))
        model = replace(model, components=usual)
    for _ in range(_ROUNDS):
        found = sizes if fit is None else sizes_of(model, fit, sizes)
        if fit is None or found.is_near(sizes):
            break
        model, sizes = replace(model, components=found.scale(usual)), found
        fit = fit_hierarchy(model, fit, relative_tolerance=_COARSE_TOLERANCE)
    fit = None if fit is None else fit_hierarchy(model, fit)
    return None if fit is None else ErrorFit(model, fit, tuple(places), sizes)


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
) -> Hierarchy:
    """The model with usual sizes; arguments as of :func:`fit_errors`."""
    findings, usual = MatcherFindings.from_metadata(metadata), error_components()
    cameras = tuple(T_camera_lidar)
    whole, share = np.square(findings.rigid_sigmas), findings.camera_share
    if not any(findings.systematic_sigmas) and inliers.pairs:  # nothing is stated
        unknown = usual.matchers[UNKNOWN]
        whole = np.square([unknown.systematic_rotation_rad, unknown.systematic_translation_m])
        share = unknown.camera_share
    of_place = np.square([findings.place_rotation_rad, findings.place_translation_m])
    at_place = np.tile(np.eye(6), (len(places), len(cameras), 1, 1))
    scatter_at_place = at_place.copy()
    usual_bends = np.asarray(findings.bend_sigmas)
    blocks, bends = {}, np.zeros((len(cameras), 6, len(usual_bends)))
    shape = len(places), len(cameras), len(usual_bends)
    bend_vector, bend_information = np.zeros(shape), np.zeros((*shape, shape[2]))
    for name, block in inliers.blocks.items():
        placed = PlacedBlock.of(block, scales[name], places)
        within = within_place(inliers, name, T_camera_lidar[name], scales[name], placed)
        at_place[:, cameras.index(name)] = within.at_place(findings.place_variance)
        scatter_at_place[:, cameras.index(name)] = within.at_place(0.0)
        blocks[name] = placed.with_variance(within.least)
        if usual_bends.any():
            pose = to_T_lidar_camera(T_camera_lidar[name])
            evidence = bend_evidence(block, scales[name], pose, WEAK, places)
            bends[cameras.index(name)] = evidence.shifts * usual_bends
            weight = 1.0 / within.mean_variance(findings.place_variance)
            units = np.outer(usual_bends, usual_bends)
            bend_information[:, cameras.index(name)] = weight * units * evidence.information
            bend_vector[:, cameras.index(name)] = weight * usual_bends * evidence.vector
    pairs = [pair for pair in inliers.pairs if len(pair.frame)]  # of some the gate leaves nothing
    components = Components(
        cloud=_covariance(*((1.0 - share) * whole)),
        cloud_at_place=_covariance(*of_place),
        camera=_covariance(*(share * whole)),
        bends=bends,
        pair_bends=shifts_of_pairs(
            bends,
            np.isin(cameras, list(inliers.blocks)),
            invert(np.stack([T_camera_lidar[name] for name in cameras])),
            sorted({(cameras.index(pair.a), cameras.index(pair.b)) for pair in pairs}),
        ),
        bend_information=bend_information,
        bend_vector=bend_vector,
        bend_weight=np.ones(shape[:2]),
        pairs=_covariance(*(pair_sigmas()[[0, 3]] ** 2 / 2)),
        at_place=at_place,
        scatter_at_place=scatter_at_place,
        robust_scale=usual.robust_sigmas if len(places) >= usual.robust_places else np.inf,
    )
    graph = join(inliers.pose_graph, _held_graph(cameras, T_camera_lidar, held))
    return Hierarchy(cameras, blocks, _placed_pairs(pairs, places), graph, components)


def _covariance(rotation_rad2: float, translation_m2: float) -> Array:
    return np.diag(np.maximum(np.repeat([rotation_rad2, translation_m2], 3), _LEAST_SIGMA**2))


def _held_graph(
    cameras: Sequence[str], T_camera_lidar: Mapping[str, Array], held: Sequence[str]
) -> gtsam.NonlinearFactorGraph:
    graph, unit = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Unit.Create(6)
    for name in held:
        pose = to_T_lidar_camera(T_camera_lidar[name])
        graph.add(gtsam.PriorFactorPose3(pose_key(cameras, name), pose, unit))
    return graph


def _placed_pairs(pairs: Sequence[PairTerm], places: Sequence[Numbers]) -> list[PlacedPair]:
    """Each term, its information that of features which err as usual in a frame."""
    found = []
    for pair in pairs:
        own = [one for one in pairs if {one.a, one.b} == {pair.a, pair.b}]
        found.append(PlacedPair.of(pair.deflate(usual_excess(own)), places))
    return found
