"""The optimization problem: matches and what is known of poses; its minimum, and what it gave."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.config import Config, Terms
from calibgraph.correspondences import Correspondences
from calibgraph.errors import CorrespondenceError
from calibgraph.graph import Optimum, joined, optimize, projection_graph
from calibgraph.matches import MIN_MATCHES, Matches, Scale
from calibgraph.rig import Rig

Array = NDArray[np.float64]
Poses = dict[str, Array]
Scales = dict[str, Scale]

_MAX_RESCALINGS = 10
_SETTLED = 0.01  # relative change of the spread
_NARROWER, _NARROWINGS = 1 / 1.5, 16  # in all from 600 px to 1 px


@dataclass(frozen=True, eq=False)
class Problem:
    """What the objective is made of (paper, Eq. 5).

    Attributes:
        cameras: all cameras of the rig, in its order.
        matches: per camera that has enough correspondences.
        pose_graph: the priors and the relative poses.
        terms: which of them are used.
        gate_hessian: of gated matches, see ``Matches.gate_hessian``; empty before the gate.
    """

    cameras: tuple[str, ...]
    matches: dict[str, Matches]
    pose_graph: gtsam.NonlinearFactorGraph
    terms: Terms
    gate_hessian: Mapping[str, Array] = field(default_factory=dict)

    @property
    def fits_matches(self) -> bool:
        """Whether the terms have a reprojection term."""
        return self.terms in ("full", "reprojection")

    def with_matches(self, matches: Mapping[str, Matches]) -> Problem:
        """The same problem with other (fewer) correspondences."""
        return replace(self, matches=dict(matches))

    def minimize(self, start: Poses, scales: Scales) -> Optimum:
        """The minimum by Levenberg-Marquardt, with the residuals' scales held."""
        if self.terms == "stage1":
            return Optimum(start, math.nan, 0, True)
        graph = self.pose_graph
        if self.fits_matches:
            blocks = {name: m.scaled(scales[name]) for name, m in self.matches.items()}
            graph = joined(projection_graph(self.cameras, blocks), graph)
        return optimize(graph, self.cameras, start)

    def settled(self, start: Poses, config: Config) -> tuple[Poses, Scales]:
        """Pass 1. With `auto` scales: fit and re-measure the spread until it stands still.

        A camera whose residuals then have no core, by far more than good matches have, is either
        far from the minimum or has few good matches. Its scale is narrowed step by step (graduated
        non-convexity), which leads to where matches are densest, until a core appears.
        """
        poses, scales = self._stood_still(start, config)
        left = {name for name, s in scales.items() if s.sigma_px > config.pnp_threshold_px}
        if not left or not self.fits_matches or config.loss_scale_px is not None:
            return poses, scales
        narrowed, tried, found = scales, poses, set[str]()
        for _ in range(_NARROWINGS):
            narrowed = narrowed | {name: narrowed[name].narrowed(_NARROWER) for name in left}
            tried = self.minimize(tried, narrowed).T_camera_lidar
            measured = {name: self.matches[name].scale(tried[name], config) for name in left}
            cores = {name for name in left if measured[name].sigma < narrowed[name].sigma}
            narrowed = narrowed | {name: measured[name] for name in cores}
            left, found = left - cores, found | cores
            if not left:
                break
        if not found:
            return poses, scales
        return self._stood_still(tried | {name: poses[name] for name in left}, config)

    def _stood_still(self, start: Poses, config: Config) -> tuple[Poses, Scales]:
        poses, scales = start, self.scales_at(start, config)
        for _ in range(_MAX_RESCALINGS):
            poses = self.minimize(poses, scales).T_camera_lidar
            before, scales = scales, self.scales_at(poses, config)
            ratios = [scales[name].sigma / before[name].sigma for name in scales]
            if all(abs(ratio - 1.0) < _SETTLED for ratio in ratios):
                break
        return poses, scales

    def scales_at(self, poses: Poses, config: Config) -> Scales:
        """The configured scales, or those of the residuals' own spread at some poses.

        Raises:
            CorrespondenceError: if a camera has all its matches behind it.
        """
        scales = {name: m.scale(poses[name], config) for name, m in self.matches.items()}
        for name, scale in scales.items():
            if math.isinf(scale.sigma_px):
                raise CorrespondenceError(
                    f"camera {name!r}: all its correspondences are behind it at the estimate; do "
                    "its guess and the relative_poses hold (p_camera = T_camera_lidar * p_lidar, "
                    "p_a = T_a_b * p_b), and are the cameras' names right?",
                    camera=name,
                )
        return scales

    def gated(self, poses: Poses, scales: Scales) -> Problem:
        """The problem without the matches beyond the gate (paper, two-pass solver, 2).

        Raises:
            CorrespondenceError: if a camera is left with too few.
        """
        inliers = {name: m.gated(poses[name], scales[name]) for name, m in self.matches.items()}
        for name, left in inliers.items():
            if len(left.frame) < MIN_MATCHES:
                raise CorrespondenceError(
                    f"camera {name!r}: only {len(left.frame)} of {len(self.matches[name].frame)} "
                    f"correspondences lie within the gate of {scales[name].gate_px:.3g} px, at "
                    f"least {MIN_MATCHES} are needed; the matches do not agree on a pose, or the "
                    "gate is too narrow",
                    camera=name,
                )
        at_edge = {
            name: m.gate_hessian(poses[name], scales[name]) for name, m in self.matches.items()
        }
        return replace(self.with_matches(inliers), gate_hessian=at_edge)


class Clock:
    """Wall time of named stages: ``with clock("stage"): ...``."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time that the body takes to a stage's."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


@dataclass(frozen=True, eq=False)
class Fit:
    """What the two passes gave.

    Attributes:
        rig: lenses, and the guess.
        table: the preprocessed correspondences.
        config: the settings.
        problem: all correspondences that were usable.
        inliers: those within the gate, which the solution was fitted to.
        scales: of the residuals.
        optimum: the solution.
        stage1_T_camera_lidar: the pairwise estimates.
        counts: per camera, what was left after each filter and gate, and the frames.
        clock: what took how long.
    """

    rig: Rig
    table: Correspondences
    config: Config
    problem: Problem
    inliers: Problem
    scales: Scales
    optimum: Optimum
    stage1_T_camera_lidar: Poses
    counts: dict[str, dict[str, int]]
    clock: Clock

    @property
    def metadata(self) -> dict[str, Any]:
        """Of the table: what the matcher says."""
        return self.table.metadata

    @property
    def systematic_sigmas(self) -> tuple[float, float]:
        """Rotation [rad] and translation [m] that the matcher says all frames share, per axis.

        The scatter between frames cannot show them.
        """
        return self.table.systematic_sigmas

    @property
    def poses(self) -> Poses:
        """The solution, T_camera_lidar per camera."""
        return self.optimum.T_camera_lidar

    @property
    def solved_rig(self) -> Rig:
        """The rig with the solution's poses."""
        return self.rig.moved_to(self.poses)
