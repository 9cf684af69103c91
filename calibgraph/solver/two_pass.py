"""Eq. 5 with the matches of a solve: start, minimum, outliers; see ``graph.objective``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.graph.lens import LensVariable
from calibgraph.graph.objective import join, objective_graph, pose_key, projection_graph
from calibgraph.model.config import Config, Terms
from calibgraph.model.geometry import (
    invert,
    pose_rows,
    relative_transform,
    to_T_camera_lidar,
    to_T_lidar_camera,
)
from calibgraph.model.rig import Rig
from calibgraph.solver.matches import MIN_MATCHES, CameraBlock
from calibgraph.solver.pairs import PairTerm, pair_graph, rows_of_pair
from calibgraph.solver.preprocess import FILTERS
from calibgraph.solver.robust import ResidualScale
from calibgraph.solver.stage1 import CameraStage1, Stage1
from factors import BlockSums, ProjectionBlock, lossless_factor

MAX_ITERATIONS = 200
"""Of Levenberg-Marquardt."""

RELATIVE_TOLERANCE = 1e-10
"""Relative change of the error at which it stops."""


@dataclass(frozen=True)
class Optimum:
    """The result of Levenberg-Marquardt.

    Attributes:
        T_camera_lidar: per camera, (4, 4).
        cost: the paper's objective there (twice GTSAM's error).
        converged: whether it stopped by its tolerance.
    """

    T_camera_lidar: dict[str, Array]
    cost: float
    converged: bool


def to_values(cameras: Sequence[str], T_camera_lidar: Mapping[str, Array]) -> gtsam.Values:
    """GTSAM values of the extrinsics, (4, 4) T_camera_lidar of every camera."""
    values = gtsam.Values()
    for name in cameras:
        values.insert(pose_key(cameras, name), to_T_lidar_camera(T_camera_lidar[name]))
    return values


def optimize(
    graph: gtsam.NonlinearFactorGraph,
    cameras: Sequence[str],
    T_camera_lidar: Mapping[str, Array],
    *,
    tolerance: float = RELATIVE_TOLERANCE,
) -> Optimum:
    """Minimize a graph by Levenberg-Marquardt.

    Args:
        graph: over the variables of the cameras.
        cameras: their names, in the order of the variables.
        T_camera_lidar: (4, 4) per camera, the start.
        tolerance: relative change of the error at which it stops.
    """
    start = to_values(cameras, T_camera_lidar)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, _parameters(tolerance))
    values = optimizer.optimize()
    found = {name: to_T_camera_lidar(values.atPose3(pose_key(cameras, name))) for name in cameras}
    return Optimum(found, 2.0 * optimizer.error(), optimizer.iterations() < MAX_ITERATIONS)


@cache
def _parameters(tolerance: float) -> gtsam.LevenbergMarquardtParams:
    """Of Levenberg-Marquardt, which copies them."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(MAX_ITERATIONS)
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(0.0)
    return parameters


Transforms = dict[str, Array]
"""Per camera, (4, 4) T_camera_lidar."""
Scales = dict[str, ResidualScale]
USING_CORRESPONDENCES: tuple[Terms, ...] = ("full", "reprojection")

_MAX_RESCALINGS = 10  # mostly 3 are enough
_CONVERGED = 0.01  # relative change of the spread: far below its own uncertainty
_NARROWING, _NARROWINGS = 1 / 1.5, 16  # in all from 600 px, half an image, to 1 px


@dataclass(frozen=True, eq=False)
class Objective:
    """Everything that Eq. 5 sums over. ``pose_graph`` is computed once, from the fields alone.

    Attributes:
        rig: its cameras are the unknowns; its ``relative_poses`` are measurements.
        blocks: per camera that has enough correspondences.
        T_hat: per camera with a Stage-1 estimate, (4, 4) T_camera_lidar: the mean of the priors.
        config: the weights lambda and mu, the loss and its scales.
        terms: which terms of Eq. 5 are used.
        gate_hessian: after the gate, (6, 6) per camera, see ``CameraBlock.gate_hessian``; before
            it, empty.
        pairs: what cameras see in common, each term with its sigma.
        lenses: those that the error model estimates; here they are where the rig has them.
    """

    rig: Rig
    blocks: Mapping[str, CameraBlock]
    T_hat: Mapping[str, Array]
    config: Config
    terms: Terms
    gate_hessian: Mapping[str, Array] = field(default_factory=dict)
    pairs: tuple[PairTerm, ...] = ()
    lenses: Mapping[str, LensVariable] = field(default_factory=dict)

    @property
    def cameras(self) -> tuple[str, ...]:
        """The unknowns, in the rig's order."""
        return tuple(self.rig.cameras)

    @property
    def uses_correspondences(self) -> bool:
        """Whether the terms include the reprojection term."""
        return self.terms in USING_CORRESPONDENCES

    def graph(self, scales: Scales) -> gtsam.NonlinearFactorGraph:
        """Eq. 5 as a GTSAM graph that can be printed.

        Args:
            scales: of the residuals; only cameras that have one get a reprojection term. Without
                any, there are no terms of pairs.
        """
        blocks, pairs = self._at(scales)
        keys = {name: pose_key(self.cameras, name) for name in self.cameras}
        reprojection = projection_graph(self.cameras, blocks)
        return join(reprojection, self.pose_graph, pair_graph(pairs, keys))

    def _at(self, scales: Scales) -> tuple[dict[str, ProjectionBlock], tuple[PairTerm, ...]]:
        """The correspondences of each camera, and the pairs, that the terms use."""
        if not (scales and self.uses_correspondences):
            return {}, ()
        return {n: self.blocks[n].with_scale(scale) for n, scale in scales.items()}, self.pairs

    @cached_property
    def pose_graph(self) -> gtsam.NonlinearFactorGraph:
        """All terms but the reprojection term: priors and measured relative poses."""
        return objective_graph(self.rig, {}, self.T_hat, self.config, terms=self.terms)

    def with_pairs(self, pairs: Sequence[PairTerm]) -> Objective:
        """The same objective with what cameras see in common."""
        return self._with(pairs=tuple(pairs))

    def _with(self, **fields: Any) -> Objective:
        """With other fields, on which the terms between poses do not depend."""
        other = replace(self, **fields)
        other.__dict__["pose_graph"] = self.pose_graph
        return other

    def data_only(self) -> Objective:
        """The reprojection term alone, of the cameras that have correspondences."""
        rig = Rig(cameras={name: self.rig.cameras[name] for name in self.blocks})
        pairs = tuple(pair for pair in self.pairs if {pair.a, pair.b} <= self.blocks.keys())
        return replace(self, rig=rig, T_hat={}, pairs=pairs)

    def minimize(
        self, start: Transforms, scales: Scales, *, tolerance: float = RELATIVE_TOLERANCE
    ) -> Optimum:
        """The minimum by Levenberg-Marquardt, with the residuals' scales held constant."""
        if self.terms == "stage1":
            return Optimum(start, math.nan, True)
        return optimize(self._joined(scales), self.cameras, start, tolerance=tolerance)

    def _joined(self, scales: Scales) -> gtsam.NonlinearFactorGraph:
        """:meth:`graph` with all correspondences and pairs as one factor.

        Their sums add, and an optimizer then asks once, not of each camera and pair.
        """
        blocks, pairs = self._at(scales)
        seen = {*blocks, *(name for pair in pairs for name in (pair.a, pair.b))}
        names = [name for name in self.cameras if name in seen]
        rows = {name: np.r_[pose_rows(number)] for number, name in enumerate(names)}
        tied = [(rows_of_pair(names, pair), pair) for pair in pairs]
        size, graph = 6 * len(names), join(self.pose_graph)

        def sums_at(*poses: gtsam.Pose3) -> tuple[BlockSums, None]:
            at, cost = dict(zip(names, poses, strict=True)), 0.0
            hessian, gradient = np.zeros((size, size)), np.zeros(size)
            parts = [(rows[name], block.sums(at[name])) for name, block in blocks.items()]
            parts += [(own, pair.block.sums(at[pair.a], at[pair.b])) for own, pair in tied]
            for own, sums in parts:
                hessian[own[:, None], own] += sums.hessian
                gradient[own] += sums.gradient
                cost += float(sums.cost)
            return BlockSums(hessian, gradient, np.array(cost)), None

        if names:
            keys = [pose_key(self.cameras, name) for name in names]
            graph.add(lossless_factor(keys, sums_at))
        return graph

    def minimize_with_scale(self, start: Transforms) -> tuple[Transforms, Scales]:
        """Pass 1. With `auto` scales: minimize and re-measure the spread until it is constant.

        A camera whose residuals then have no core, with a spread far above that of good matches, is
        either far from the minimum or has few good matches. Its scale is narrowed step by step
        (graduated non-convexity), which leads to where matches are densest, until a core appears.
        """
        rough, scales = self._alternate(start)
        limit_px = self.config.pnp_threshold_px
        left = {name for name, scale in scales.items() if scale.sigma_px > limit_px}
        if not left or not self.uses_correspondences or self.config.loss_scale_px is not None:
            return rough, scales
        narrow, T_camera_lidar, found = scales, rough, set[str]()
        for _ in range(_NARROWINGS):
            narrow = narrow | {name: narrow[name].narrow(_NARROWING) for name in left}
            T_camera_lidar = self.minimize(T_camera_lidar, narrow).T_camera_lidar
            measured = {
                name: self.blocks[name].scale(T_camera_lidar[name], self.config) for name in left
            }
            cores = {name for name in left if measured[name].sigma < narrow[name].sigma}
            narrow = narrow | {name: measured[name] for name in cores}
            left, found = left - cores, found | cores
            if not left:
                break
        if not found:
            return rough, scales
        return self._alternate(T_camera_lidar | {name: rough[name] for name in left})

    def _alternate(self, start: Transforms) -> tuple[Transforms, Scales]:
        """Minimize and measure the scales in turn until these are constant."""
        T_camera_lidar, scales = start, self.scales_at(start)
        for _ in range(_MAX_RESCALINGS):
            T_camera_lidar = self.minimize(T_camera_lidar, scales).T_camera_lidar
            before, scales = scales, self.scales_at(T_camera_lidar)
            ratios = [scales[name].sigma / before[name].sigma for name in scales]
            if all(abs(ratio - 1.0) < _CONVERGED for ratio in ratios):
                break
        return T_camera_lidar, scales

    def scales_at(self, T_camera_lidar: Transforms) -> Scales:
        """The configured scales, or those of the residuals' own spread at some extrinsics.

        Raises:
            CorrespondenceError: if a camera has all its correspondences behind it.
        """
        scales = {
            name: block.scale(T_camera_lidar[name], self.config)
            for name, block in self.blocks.items()
        }
        for name, scale in scales.items():
            if math.isinf(scale.sigma_px):
                raise CorrespondenceError(
                    f"camera {name!r}: all its correspondences are behind it at the estimate; do "
                    "its guess and the relative_poses hold (p_camera = T_camera_lidar * p_lidar, "
                    "p_a = T_a_b * p_b), and are the cameras' names right?",
                    camera=name,
                )
        return scales

    def without_outliers(self, T_camera_lidar: Transforms, scales: Scales) -> Objective:
        """The objective without the correspondences beyond the gate tau (paper, section 3.4).

        Raises:
            CorrespondenceError: if a camera is left with too few.
        """
        inliers = {
            name: block.without_outliers(T_camera_lidar[name], scales[name])
            for name, block in self.blocks.items()
        }
        for name, kept in inliers.items():
            if len(kept) < MIN_MATCHES:
                raise CorrespondenceError(
                    f"camera {name!r}: only {len(kept)} of {len(self.blocks[name])} "
                    f"correspondences lie within the gate of {scales[name].gate_px:.3g} px, at "
                    f"least {MIN_MATCHES} are needed; the matches do not agree on a pose, or the "
                    "gate is too narrow",
                    camera=name,
                )
        moving = {n: b.gate_hessian(T_camera_lidar[n], scales[n]) for n, b in self.blocks.items()}
        return self._with(blocks=inliers, gate_hessian=moving)


def best_start(
    rig: Rig,
    blocks: Mapping[str, CameraBlock],
    stage1: Stage1,
    config: Config,
    *,
    terms: Terms,
    tied: Sequence[tuple[str, str]] = (),
) -> Transforms:
    """Per camera, (4, 4) T_camera_lidar from which the first pass starts.

    The best of Stage 1, the PnP of single frames and the rig's guess, by the mean Cauchy loss of
    all frames' correspondences at half the PnP threshold; with the terms ``stage1``, Stage 1
    itself. Cameras without correspondences start from a relative pose to one that has them: a
    measured one, or that of the guess to a camera that sees the same; else from their guess.

    Raises:
        CorrespondenceError: with the terms ``stage1``, if PnP failed in every frame of a camera.
    """
    start = {}
    for name, block in blocks.items():
        candidates = _candidates(name, rig, stage1.get(name), terms)
        start[name] = candidates[block.best_candidate(candidates, config.pnp_threshold_px / 2)]
    for _ in rig.cameras:  # the longest chain of relative poses
        for pair in rig.relative_poses:
            if pair.b in start:
                start.setdefault(pair.a, pair.T_a_b @ start[pair.b])
            if pair.a in start:
                start.setdefault(pair.b, invert(pair.T_a_b) @ start[pair.a])
        for one, other in (*tied, *((b, a) for a, b in tied)):
            if one in start:
                T_other_one = relative_transform(
                    *(rig.cameras[n].T_camera_lidar for n in (other, one))
                )
                start.setdefault(other, T_other_one @ start[one])
    return {name: start.get(name, camera.T_camera_lidar) for name, camera in rig.cameras.items()}


def _candidates(
    name: str, rig: Rig, estimate: CameraStage1 | None, terms: Terms
) -> list[NDArray[np.float64]]:
    """(4, 4) each: T_camera_lidar of Stage 1, of the rig, and of single frames."""
    T_hat = estimate.T_camera_lidar if estimate else None
    if terms == "stage1":
        if T_hat is None:
            raise CorrespondenceError(
                f"camera {name!r}: PnP failed in every frame, so there is no Stage-1 estimate; "
                "solve with other terms, or give more matches per frame",
                camera=name,
            )
        return [T_hat]
    stage1 = [] if T_hat is None else [T_hat]
    single = estimate.by_frame.values() if estimate else ()
    return [*stage1, rig.cameras[name].T_camera_lidar, *single]


def require_determined(
    rig: Rig,
    counts: Mapping[str, Mapping[str, int]],
    tied_by_images: Sequence[tuple[str, str]] = (),
    excluded: Sequence[str] = (),
) -> tuple[str, ...]:
    """Check that every camera has correspondences, or is tied to one that has.

    Args:
        rig: with its relative poses.
        counts: per camera, correspondences left after each filter.
        tied_by_images: the pairs of cameras that see enough in common.
        excluded: cameras that may have neither, as long as there are others.

    Returns:
        The cameras that have neither.

    Raises:
        CorrespondenceError: naming the first of them that may not.
    """
    tied = {name for name, count in counts.items() if count["capped"] >= MIN_MATCHES}
    for _ in rig.cameras:
        tied |= {p.a for p in rig.relative_poses if p.b in tied}
        tied |= {p.b for p in rig.relative_poses if p.a in tied}
        tied |= {name for pair in tied_by_images if tied & set(pair) for name in pair}
    held = tuple(name for name in counts if name not in tied)
    for name in held:
        if name in excluded and tied:
            continue
        count = counts[name]
        left = ", ".join(f"{count[filter]} {filter}" for filter in FILTERS)
        raise CorrespondenceError(
            f"camera {name!r} has {count['capped']} usable correspondences, at least "
            f"{MIN_MATCHES} are needed, or a relative pose to a camera that has them "
            f"(left after each filter: {left}): {_advice(count)}{_advice_for_others(tied)}",
            camera=name,
        )
    return held


def require_known(rig: Rig, names: Sequence[str]) -> None:
    """Check the cameras that the settings exclude.

    Raises:
        ValueError: if the rig lacks one.
    """
    for name in names:
        if name not in rig.cameras:
            known = ", ".join(rig.cameras)
            raise ValueError(f"excluded_cameras names {name!r}; the rig has {known}")


def _advice_for_others(tied: set[str]) -> str:
    """How to calibrate the cameras that have enough."""
    if not tied:
        return ""
    return (
        f"; to calibrate {', '.join(sorted(tied))} without it, take it out of the rig file, or "
        "name it in excluded_cameras of the settings"
    )


def _advice(count: Mapping[str, int]) -> str:
    """What to do about too few correspondences, by the filter that removed them."""
    if count["given"] < MIN_MATCHES:
        return (
            "none or few were found; check that its images show something, that the cloud lies "
            "where T_camera_lidar looks (p_camera = T_camera_lidar * p_lidar), and its name"
        )
    if count["projectable"] < MIN_MATCHES:
        return (
            "the points are not in front of it; check the direction of T_camera_lidar "
            "(p_camera = T_camera_lidar * p_lidar), its axes and its units"
        )
    if count["confident"] < MIN_MATCHES:
        return "their confidence is below confidence_min; lower it if they can be trusted"
    return "they crowd in few cells of the image; match more of it"
