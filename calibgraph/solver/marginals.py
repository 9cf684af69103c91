"""The covariance of a solution, and all that it is made of: the marginal of its graph.

With the preset ``auto`` it is the marginal of the error model. The paper's presets have no error
model: there it is the sandwich, by the scatter between frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.latent_poses import latent_pose_graph
from calibgraph.model.error_sources import COMMON, FLAT, PAIRS, PLACES, TIMES, ErrorSources
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.conflicts import Conflict, relative_pose_conflict
from calibgraph.solver.covariance import cluster_robust_covariance, data_sigmas
from calibgraph.solver.curvature import Curvature, curvature_at, robust_hessians
from calibgraph.solver.error_model import ErrorFit, fit_errors, fit_without_priors
from calibgraph.solver.error_shares import (
    predict_variances,
    sources_of_error,
    variances_by_source,
)
from calibgraph.solver.objective import Objective, Transforms
from calibgraph.solver.pair_refinement import PairFit, fit_pairs
from calibgraph.solver.shared_error import error_between, shared_scatter, shared_variance_ratio
from factors import pose_sigmas

if TYPE_CHECKING:
    from calibgraph.solver.solution import Solution

Array = NDArray[np.float64]

_HELD_RAD, _HELD_M = np.radians(0.1), 0.02  # a camera, if its covariance is unknown


@dataclass(frozen=True, eq=False)
class DataOnly:
    """The solution of the correspondences alone, without priors and relative poses.

    Attributes:
        T_camera_lidar: per camera that has correspondences, (4, 4).
        covariance: (6 M, 6 M) in the order of ``T_camera_lidar``, or None.
    """

    T_camera_lidar: Transforms
    covariance: Array | None


@dataclass(frozen=True, eq=False)
class Marginals:
    """The covariance of a solution and its parts, each computed once, when it is needed.

    Attributes:
        solution: of the joint solve.
    """

    solution: Solution

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the rig's order."""
        return tuple(self.solution.T_camera_lidar)

    @property
    def findings(self) -> MatcherFindings:
        """The findings of the matcher."""
        return self.solution.correspondences.findings

    @cached_property
    def covariance(self) -> Array | None:
        """(6 N, 6 N): the marginal of the error model; with the paper's presets, the sandwich."""
        solution = self.solution
        if solution.config.preset == "auto":
            return None if self.errors is None else self.errors.fit.covariance
        if self.scatter is None:
            return None
        shared = self.shared_variance_ratio * self._shared(solution.inliers, self.curvature)
        return (
            self.scatter + shared + error_between(solution.T_camera_lidar, solution.inliers.pairs)
        )

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph whose optimum and marginal they are; with the paper's presets, Eq. 5."""
        if self.errors is not None:
            return latent_pose_graph(self.errors.model)
        return self.solution.inliers.graph(self.solution.scales)

    @cached_property
    def errors(self) -> ErrorFit | None:
        """The error model of the solution; None with the paper's presets.

        The shared error is at least as large as pairs of images show, even if the loss rejects
        them.
        """
        solution = self.solution
        found = solution.errors or fit_errors(
            solution.fitted, self.findings, solution.correspondences.places
        )
        return None if found is None else found.with_shared_ratio(self.shared_variance_ratio)

    @cached_property
    def curvature(self) -> Curvature:
        """The curvature of all terms at the solution."""
        return curvature_at(self.solution.fitted, self.robust_hessians)

    @cached_property
    def scatter(self) -> Array | None:
        """(6 N, 6 N) covariance by the scatter between frames, or None."""
        return cluster_robust_covariance(self.solution.fitted, self.curvature)

    @cached_property
    def robust_hessians(self) -> Mapping[str, Array]:
        """Per camera, (6, 6) of the inliers at the solution; empty if the terms do not use them."""
        return robust_hessians(self.solution.fitted)

    @cached_property
    def data_sigmas(self) -> Array | None:
        """(N, 6) standard deviations if every correspondence were independent."""
        solution = self.solution
        if not solution.inliers.uses_correspondences:
            return None
        return data_sigmas(solution.fitted)

    def error_sources(self, joint: Array) -> dict[str, ErrorSources]:
        """Per camera with an error bar, the shares of its sources.

        Args:
            joint: (6 N, 6 N) the reported covariance, which may be wider than that of the matches.
        """
        if self.covariance is None:
            return {}
        total, held = np.diag(self.covariance), self.solution.held
        if self.errors is None:
            parts = self._sandwich_parts
            fixed = parts[COMMON] + parts[PAIRS]
            forecast = {times: fixed + (total - fixed) / times for times in TIMES}
        else:
            parts, forecast = variances_by_source(self.errors), predict_variances(self.errors)
        flat = np.diag(joint) - total
        forecast = {times: variance + flat / times for times, variance in forecast.items()}
        total, parts = total + flat, {**parts, FLAT: flat}
        return {
            name: sources_of_error(total, parts, forecast, number)
            for number, name in enumerate(self.cameras)
            if name not in held
        }

    @property
    def _sandwich_parts(self) -> dict[str, Array]:
        """Per source but the matches, (6 N,) variances, with the paper's presets."""
        inliers, T_camera_lidar = self.solution.inliers, self.solution.T_camera_lidar
        no_places = replace(self.findings, place_variance=0.0)
        every, common = (
            self.shared_variance_ratio * np.diag(self._shared(inliers, self.curvature, findings))
            for findings in (self.findings, no_places)
        )
        between = np.diag(error_between(T_camera_lidar, inliers.pairs))
        return {COMMON: common, PLACES: every - common, PAIRS: between}

    @cached_property
    def shared_variance_ratio(self) -> float:
        """Variance of the shared error relative to its prior, from co-visible features."""
        own = self.solution.without_pairs().marginals
        if own is self or own.covariance is None:
            return 1.0
        return shared_variance_ratio(own.solution.T_camera_lidar, own.covariance, own.pair_fits)

    @cached_property
    def pair_fits(self) -> list[PairFit]:
        """The relative poses of pairs by images, the first camera held near the solution."""
        return self.fit_pairs_near(self.covariance)

    def fit_pairs_near(self, joint: Array | None) -> list[PairFit]:
        """The same, the first camera held by some (6 N, 6 N) covariance."""
        solution = self.solution
        if solution.camera_matches is None:
            return []
        known = self.known_or_prior(joint)
        held = [known[pose_rows(number), pose_rows(number)] for number in range(len(self.cameras))]
        matches = solution.camera_matches
        return fit_pairs(solution.solved_rig, matches, solution.config, np.array(held))

    def known_or_prior(self, joint: Array | None) -> Array:
        """(6 N, 6 N) covariance of the solution; a prior where it is not determined."""
        if joint is not None:
            return joint
        held = pose_sigmas(rotation_rad=_HELD_RAD, translation_m=_HELD_M) ** 2
        return np.diag(np.tile(held, len(self.cameras)))

    def _shared(
        self, inliers: Objective, curvature: Curvature, findings: MatcherFindings | None = None
    ) -> Array:
        """(6 N, 6 N) covariance of a solution by the prior of the error that all frames share."""
        places = self.solution.correspondences.places
        repeats = {
            name: places.frames_per_place(block.frame_numbers)
            for name, block in inliers.blocks.items()
        }
        T_camera_lidar = {name: self.solution.T_camera_lidar[name] for name in inliers.cameras}
        scatter = shared_scatter(findings or self.findings, T_camera_lidar, curvature, repeats)
        return curvature.sandwich(scatter)

    @cached_property
    def data_only(self) -> DataOnly | None:
        """The solution of the correspondences alone; None where there is nothing else."""
        solution = self.solution
        if not solution.inliers.uses_correspondences or not solution.inliers.pose_graph.size():
            return None
        if (found := self._data_only_by_errors) is not None:
            return found
        free = solution.fitted.data_only()
        if solution.config.preset == "auto":
            return DataOnly(free.T_camera_lidar, None)
        curvature = curvature_at(free, robust_hessians(free))
        scatter = cluster_robust_covariance(free, curvature)
        if scatter is None:
            return DataOnly(free.T_camera_lidar, None)
        shared = self._shared(free.objective, curvature)
        between = error_between(free.T_camera_lidar, free.objective.pairs)
        return DataOnly(free.T_camera_lidar, scatter + (shared + between))

    @property
    def _data_only_by_errors(self) -> DataOnly | None:
        """The same by the error model, None where there is none."""
        solution, errors = self.solution, self.errors
        if errors is not None and errors.without_priors is None and not solution.rig.relative_poses:
            fit = errors.drop_pose_graph()  # near its minimum already
            if fit is not None and len(errors.model.blocks) == len(self.cameras):
                return DataOnly(fit.T_camera_lidar, fit.covariance)
        alone = None if errors is None else errors.without_priors
        if alone is None:
            places = solution.correspondences.places
            alone = fit_without_priors(solution.fitted, self.findings, places)
        return None if alone is None else DataOnly(alone.T_camera_lidar, alone.fit.covariance)

    @cached_property
    def conflicts(self) -> tuple[Conflict, ...]:
        """The factors of relative poses between cameras that both have correspondences."""
        free, cameras = self.data_only, tuple(self.solution.inliers.blocks)
        if free is None:
            return ()
        return tuple(
            relative_pose_conflict(pair, cameras, free.T_camera_lidar, free.covariance)
            for pair in self.solution.rig.relative_poses
            if pair.a in cameras and pair.b in cameras
        )
