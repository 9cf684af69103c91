"""The values that checks share, each computed once, when the first check needs it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.graph.latent_poses import latent_pose_graph
from calibgraph.model.calibration import Residuals
from calibgraph.model.error_sources import COMMON, FLAT, PAIRS, PLACES, TIMES, ErrorSources
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_difference, pose_rows, relative_transform
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock
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
from calibgraph.solver.solution import Solution
from calibgraph.trust.bootstrap import bootstrap_covariance
from calibgraph.trust.estimate import Estimate
from calibgraph.trust.observability import prior_shares, shares_of_marginal
from calibgraph.trust.pose_posterior import PosePosterior, no_posteriors, widen
from calibgraph.trust.probability import probability_beyond
from calibgraph.trust.thresholds import limit
from factors import pose_sigmas

Array = NDArray[np.float64]

_HELD_RAD, _HELD_M = np.radians(0.1), 0.02  # a camera, if its covariance is unknown

Checks = Mapping[str, Sequence[Check]]
"""Per camera, its checks; a camera without any may be left out."""


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
class Evidence:
    """A solution, the first guess, and the values that checks compute from them.

    Attributes:
        solution: of the joint solve.
        guess: the rig as it was first guessed.
        measure_posteriors: of the (6, 6) covariances by the matches, per camera, the posteriors by
            the images' evidence; none where nothing but correspondences is known.
    """

    solution: Solution
    guess: Rig
    measure_posteriors: Callable[[Mapping[str, Array]], Mapping[str, PosePosterior]] = no_posteriors

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the rig's order."""
        return tuple(self.solution.T_camera_lidar)

    @property
    def of_correspondences(self) -> Evidence:
        """The evidence of the solution without camera-to-camera matches."""
        return self if self.solution.before_pairs is None else self._without_pairs

    @cached_property
    def _without_pairs(self) -> Evidence:
        return Evidence(self.solution.without_pairs(), self.guess)

    @property
    def findings(self) -> MatcherFindings:
        """The findings of the matcher."""
        return self.solution.correspondences.findings

    @cached_property
    def fitted_blocks(self) -> Mapping[str, CameraBlock]:
        """Per camera, the correspondences of pass 1, before the gate; none of outlier frames."""
        objective = self.solution.objective
        return objective.blocks if objective.uses_correspondences else {}

    @cached_property
    def residuals(self) -> dict[str, Residuals]:
        """Per camera that has correspondences, of all of them, not only the inliers."""
        solution = self.solution
        return {
            name: block.at(solution.T_camera_lidar[name]).summary(solution.scales[name])
            for name, block in solution.objective.blocks.items()
        }

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
    def joint_covariance(self) -> Array | None:
        """(6 N, 6 N): of the matches, widened where the images' evidence is flat.

        Cameras that are held are unknown by a radian and a metre.
        """
        if self.covariance_of_matches is None:
            return None
        posteriors = self.posteriors.items()
        moments = {self.cameras.index(name): found.moments for name, found in posteriors}
        return widen(self.covariance_of_matches, moments)

    @cached_property
    def posteriors(self) -> Mapping[str, PosePosterior]:
        """Per free camera, its posterior by the images' evidence."""
        if self.covariance_of_matches is None:
            return {}
        free = [name for name in self.cameras if name not in self.solution.held]
        known = self.covariance_of_matches
        return self.measure_posteriors({name: self._rows_of(known, name) for name in free})

    def probability_beyond(self, camera: str) -> float:
        """The probability that its error is beyond the tolerance, by its posterior."""
        known = None if camera in self.solution.held else self.covariance_of_matches
        if known is None:
            return 0.0
        tolerance, own = self.solution.config.tolerance, self._rows_of(known, camera)
        if camera not in self.posteriors:
            return probability_beyond(own, tolerance)
        return self.posteriors[camera].probability_beyond(own, tolerance)

    @cached_property
    def covariance_of_matches(self) -> Array | None:
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

    def build_graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph whose optimum and marginal are reported; with the paper's presets, Eq. 5."""
        if self.errors is not None:
            return latent_pose_graph(self.errors.model)
        return self.solution.inliers.graph(self.solution.scales)

    @cached_property
    def error_sources(self) -> dict[str, ErrorSources]:
        """Per camera with an error bar, the shares of its sources."""
        if self.covariance_of_matches is None or self.joint_covariance is None:
            return {}
        total, held = np.diag(self.covariance_of_matches), self.solution.held
        if self.errors is None:
            parts = self._sandwich_parts
            fixed = parts[COMMON] + parts[PAIRS]
            forecast = {times: fixed + (total - fixed) / times for times in TIMES}
        else:
            parts, forecast = variances_by_source(self.errors), predict_variances(self.errors)
        flat = np.diag(self.joint_covariance) - total
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
    def shared_variance_ratio(self) -> float:
        """Variance of the shared error relative to its prior, from co-visible features."""
        own = self.of_correspondences
        if own is self or own.joint_covariance is None:
            return 1.0
        return shared_variance_ratio(
            own.solution.T_camera_lidar, own.joint_covariance, own.pair_fits
        )

    @cached_property
    def pair_fits(self) -> list[PairFit]:
        """The relative poses of pairs by images, the first camera held near the solution."""
        matches = self.solution.camera_matches
        if matches is None:
            return []
        held = [self._block(self.pair_covariance, name) for name in self.cameras]
        return fit_pairs(self.solution.solved_rig, matches, self.solution.config, np.array(held))

    @cached_property
    def pair_covariance(self) -> Array:
        """(6 N, 6 N) covariance of the solution; a prior where it is not determined."""
        if self.joint_covariance is not None:
            return self.joint_covariance
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

    def scatter_of(self, camera: str) -> Array | None:
        """(6, 6) of one camera, by the scatter between frames."""
        return self._block(self.scatter, camera)

    def covariance_of(self, camera: str) -> Array | None:
        """(6, 6) of one camera, with the error that all the matcher's frames share."""
        joint = None if camera in self.solution.held else self.joint_covariance
        return self._block(joint, camera)

    def _block(self, joint: Array | None, camera: str) -> Array | None:
        return None if joint is None else self._rows_of(joint, camera)

    def _rows_of(self, joint: Array, camera: str) -> Array:
        """(6, 6) of one camera, of the (6 N, 6 N) of all."""
        rows = pose_rows(self.cameras.index(camera))
        return joint[rows, rows]

    @cached_property
    def bootstrap(self) -> dict[str, Array]:
        """Per camera (6, 6) scatter of re-solves from frames drawn again; empty if not wanted."""
        return bootstrap_covariance(self.solution)

    @cached_property
    def prior_shares(self) -> dict[str, float]:
        """Per camera, which share of its result comes from priors and relative poses."""
        if self.errors is None:
            return prior_shares(self.solution, self.robust_hessians)
        return shares_of_marginal(self.solution, self.errors.fit.covariance)

    @cached_property
    def data_sigmas(self) -> Array | None:
        """(N, 6) standard deviations if every correspondence were independent."""
        solution = self.solution
        if not solution.inliers.uses_correspondences:
            return None
        return data_sigmas(solution.fitted)

    @cached_property
    def even_frames(self) -> NDArray[np.int64]:
        """Every other one of the frames that any camera has inliers in."""
        blocks = self.solution.inliers.blocks.values()
        return np.unique(np.concatenate([b.frame_numbers for b in blocks]))[::2]

    @cached_property
    def halves(self) -> dict[str, tuple[Array, Array]]:
        """Per camera (4, 4) T_camera_lidar from the even and from the odd frames, if possible."""
        inliers = self.solution.inliers
        if not inliers.uses_correspondences:
            return {}
        solutions = []
        even = {n: block.in_frames(self.even_frames) for n, block in inliers.blocks.items()}
        for odd in (False, True):
            half = {n: block.select(even[n] != odd) for n, block in inliers.blocks.items()}
            if any(len(block.frame) < MIN_MATCHES for block in half.values()):
                return {}
            optimum = inliers.with_blocks(half).minimize(
                self.solution.T_camera_lidar, self.solution.scales
            )
            solutions.append(optimum.T_camera_lidar)
        return {name: (solutions[0][name], solutions[1][name]) for name in inliers.blocks}

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
        if self.data_only is None:
            return ()
        T_camera_lidar, covariance = self.data_only.T_camera_lidar, self.data_only.covariance
        cameras = tuple(self.solution.inliers.blocks)
        return tuple(
            relative_pose_conflict(pair, cameras, T_camera_lidar, covariance)
            for pair in self.solution.rig.relative_poses
            if pair.a in cameras and pair.b in cameras
        )

    def pull_of(self, camera: str) -> tuple[float, float] | None:
        """How far priors and relative poses pull a camera from its own solution: deg, cm.

        None if nothing pulls, or by less than ``pull_sigmas`` of the camera's own solution.
        """
        if self.data_only is None or camera not in self.solution.inliers.blocks:
            return None
        own, covariance = self.data_only.T_camera_lidar[camera], self.data_only.covariance
        joint = self.solution.T_camera_lidar[camera]
        if covariance is not None:
            first = 6 * tuple(self.solution.inliers.blocks).index(camera)
            sigmas = np.sqrt(np.diag(covariance))[first : first + 6]
            step = gtsam.Pose3.Logmap(gtsam.Pose3(relative_transform(joint, own)))
            if np.abs(step / sigmas).max() < limit("pull_sigmas"):
                return None
        return pose_difference(joint, own)

    def estimate(self, camera: str) -> Estimate:
        """The input of the checks of one camera's estimate.

        Of the matches alone: where the images are flat, the error bar says so, and no check fails.
        """
        solution, block = self.solution, self.solution.inliers.blocks.get(camera)
        sigmas, held = self.data_sigmas, camera in solution.held
        return Estimate(
            camera=solution.rig.cameras[camera],
            residuals=self.residuals.get(camera),
            used=0 if block is None else len(block.frame),
            frames=0 if block is None else len(block.frame_edges) - 1,
            covariance=None if held else self._block(self.covariance_of_matches, camera),
            data_sigmas=None if sigmas is None else sigmas[self.cameras.index(camera)],
            halves=self.halves.get(camera),
            conflicts=tuple(c for c in self.conflicts if camera in (c.pair.a, c.pair.b)),
            pull=self.pull_of(camera),
            converged=solution.optimum.converged,
            terms=solution.terms,
            held=held,
            scatter_only=not self.findings.states_common_error,
            tolerance=solution.config.tolerance,
        )


def concatenate(parts: Sequence[Checks], cameras: Sequence[str]) -> dict[str, list[Check]]:
    """Per camera the checks of all parts, one part after the other."""
    return {name: [check for part in parts for check in part.get(name, ())] for name in cameras}
