"""Eq. 5 with the matches of a solve: its minimum, its outliers; see ``graph.objective``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.graph.lens import LensVariable
from calibgraph.graph.objective import join, objective_graph, pose_key, projection_graph
from calibgraph.model.config import Config, Terms
from calibgraph.model.rig import Rig
from calibgraph.solver.block_residuals import BlockResiduals
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock
from calibgraph.solver.camera_pairs import PairTerm, pair_graph
from calibgraph.solver.optimizer import Optimum, optimize
from calibgraph.solver.residual_scale import ResidualScale

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
        gated: after the gate, per camera all correspondences, and the (4, 4) T_camera_lidar and the
            scale that it was drawn at; before it, empty.
        pairs: what cameras see in common, each term with its sigma.
        lenses: those that the error model estimates; here they are where the rig has them.
    """

    rig: Rig
    blocks: Mapping[str, CameraBlock]
    T_hat: Mapping[str, Array]
    config: Config
    terms: Terms
    gated: Mapping[str, tuple[CameraBlock, Array, ResidualScale]] = field(default_factory=dict)
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
        blocks = {name: self.blocks[name].with_scale(scale) for name, scale in scales.items()}
        keys = {name: pose_key(self.cameras, name) for name in self.cameras}
        pairs = self.pairs if scales else ()
        reprojection = projection_graph(self.cameras, blocks if self.uses_correspondences else {})
        return join(reprojection, self.pose_graph, pair_graph(pairs, keys))

    @cached_property
    def pose_graph(self) -> gtsam.NonlinearFactorGraph:
        """All terms but the reprojection term: priors and measured relative poses."""
        return objective_graph(self.rig, {}, self.T_hat, self.config, terms=self.terms)

    @cached_property
    def gate_hessian(self) -> dict[str, Array]:
        """(6, 6) per camera after the gate, see ``BlockResiduals.gate_hessians``."""
        return {
            name: BlockResiduals.at(T, block).gate_hessians(scale)[0]
            for name, (block, T, scale) in self.gated.items()
        }

    def with_blocks(self, blocks: Mapping[str, CameraBlock]) -> Objective:
        """The same objective with other (fewer) correspondences, and the pairs of their frames."""
        if not self.pairs:
            return self._with(blocks=dict(blocks))
        frames = np.concatenate([b.frame_numbers for b in blocks.values()])
        pairs = tuple(pair.select(np.isin(pair.frame, frames)) for pair in self.pairs)
        return self._with(blocks=dict(blocks), pairs=pairs)

    def _with(self, **fields: Any) -> Objective:
        """With other fields, on which the terms between poses do not depend."""
        other = replace(self, **fields)
        other.__dict__["pose_graph"] = self.pose_graph
        return other

    def without_pairs(self) -> Objective:
        """The same objective without what cameras see in common."""
        return self._with(pairs=())

    def data_only(self) -> Objective:
        """The reprojection term alone, of the cameras that have correspondences."""
        rig = Rig(cameras={name: self.rig.cameras[name] for name in self.blocks})
        pairs = tuple(pair for pair in self.pairs if {pair.a, pair.b} <= self.blocks.keys())
        free = replace(self, rig=rig, T_hat={}, pairs=pairs)
        free.__dict__["gate_hessian"] = self.gate_hessian  # the same gate
        return free

    def minimize(self, start: Transforms, scales: Scales) -> Optimum:
        """The minimum by Levenberg-Marquardt, with the residuals' scales held constant."""
        if self.terms == "stage1":
            return Optimum(start, math.nan, 0, True)
        return optimize(self.graph(scales), self.cameras, start)

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
        gated = {n: (block, T_camera_lidar[n], scales[n]) for n, block in self.blocks.items()}
        return self.with_blocks(inliers)._with(gated=gated)
