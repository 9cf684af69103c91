"""What the joint solve returns: the optimum, its covariance, and all that checks of it need.

With the preset ``auto`` the estimate is the optimum of the error model. With the paper's presets it
is the minimum of Eq. 5, and the model serves for its covariance alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import latent_pose_graph
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.geometry import pose_rows
from calibgraph.model.lens import LensEstimate
from calibgraph.model.rig import Rig
from calibgraph.solver.covariance import FittedObjective
from calibgraph.solver.error_model import (
    Conflict,
    fit_errors,
    fit_without_priors,
    relative_pose_conflict,
)
from calibgraph.solver.lens import lens_estimates, moved_lenses, put_into, travel_errors
from calibgraph.solver.pair_refinement import (
    PairFit,
    Places,
    fit_pairs,
    place_pairs,
    shared_variance_ratio,
)
from calibgraph.solver.pairs import PairTerm, pair_terms
from calibgraph.solver.places import ErrorFit
from calibgraph.solver.sources import error_sources
from calibgraph.solver.two_pass import Objective, Optimum, Scales, Transforms


@dataclass(frozen=True, eq=False)
class Solution:
    """The result of the two passes.

    Attributes:
        rig: lenses, and the initial guess.
        correspondences: as preprocessed.
        objective: with all usable correspondences.
        inliers: with those within the gate, which the solution was fitted to.
        scales: per camera, of the residuals.
        optimum: of the last pass.
        counts: per camera, correspondences left after each filter and gate, and frames.
        timings_s: seconds per stage.
        camera_matches: what cameras see in common; None if it was not given.
        alone: the solution without it; None if no pair of cameras had enough.
        held: cameras that nothing determines; they stay where the rig has them.
        errors: the error model that the optimum is of; None where it is that of the objective.
    """

    rig: Rig
    correspondences: Correspondences
    objective: Objective
    inliers: Objective
    scales: Scales
    optimum: Optimum
    counts: Mapping[str, Mapping[str, int]]
    timings_s: Mapping[str, float]
    camera_matches: CameraMatches | None = None
    alone: Solution | None = None
    held: tuple[str, ...] = ()
    errors: ErrorFit | None = None

    @property
    def T_camera_lidar(self) -> Transforms:
        """Per camera, the (4, 4) estimate: p_camera = T_camera_lidar * p_lidar."""
        return dict(self.optimum.T_camera_lidar)

    @cached_property
    def fitted(self) -> FittedObjective:
        """The objective that it was fitted to, with its scales, at the estimate."""
        return FittedObjective(self.inliers, self.scales, self.T_camera_lidar, tuple(self.held))

    @property
    def T_hat(self) -> Transforms:
        """Per camera that has one, the (4, 4) Stage-1 estimate."""
        return dict(self.objective.T_hat)

    @property
    def config(self) -> Config:
        """The settings."""
        return self.objective.config

    @property
    def terms(self) -> Terms:
        """The terms of the objective that were used."""
        return self.objective.terms

    @cached_property
    def solved_rig(self) -> Rig:
        """The rig with the estimated extrinsics, and lenses if these are estimated."""
        lenses, _ = moved_lenses(self.inliers.lenses, self.errors)
        return put_into(self.rig.moved_to(self.T_camera_lidar), lenses)

    @cached_property
    def _lenses(self) -> tuple[dict[str, tuple[LensEstimate, ...]], dict[str, Array]]:
        return ({}, {}) if self.errors is None else lens_estimates(self.errors)

    @property
    def lens(self) -> dict[str, tuple[LensEstimate, ...]]:
        """Per camera whose lens is estimated, its parameters."""
        return self._lenses[0]

    @property
    def lens_covariance(self) -> dict[str, Array]:
        """Per camera whose lens is estimated, (6 + k, 6 + k) of pose, lens and clock."""
        return {name: joint.copy() for name, joint in self._lenses[1].items()}

    @cached_property
    def error_fit(self) -> ErrorFit | None:
        """The error model at the estimate: ``errors``, or for its covariance alone.

        None as of ``fit_errors``. The shared error is at least as large as pairs of images show,
        even if the loss rejects them.
        """
        table, least = self.correspondences, 1.0
        found = self.errors or fit_errors(self.fitted, table.findings, table.places)
        if self.alone is not None and (mount := self.alone.mount) is not None:
            known = mount.T_camera_lidar, mount.covariance
            least = shared_variance_ratio(*known, self.alone.pair_fits)
        return None if found is None else found.with_shared_ratio(least)

    @property
    def covariance(self) -> Array | None:
        """(6 N, 6 N) of all extrinsics, in the rig's order; None if a direction is undetermined.

        Of xi in T_camera_lidar = exp(xi) estimate, xi = (rotation [rad], translation [m]): the
        marginal of the error model.
        """
        return None if self.error_fit is None else self.error_fit.covariance

    @cached_property
    def travel(self) -> Array:
        """(6 N, 3) what a drive does to poses whose clouds are not corrected for its motion.

        By one standard deviation of each motion. It is no part of ``covariance``: the images of
        this drive show these poses.
        """
        return travel_errors(self.fitted)

    @cached_property
    def by_lidars(self) -> Array:
        """(6 N, k) of poses, by a standard deviation of errors of the poses of other LiDARs."""
        known = self.correspondences.findings.by_lidars
        size = max((np.shape(of)[1] for of in known.values()), default=0)
        each = [known.get(name, np.zeros((6, size))) for name in self.T_camera_lidar]
        return np.array(each, np.float64).reshape(6 * len(each), size)

    @cached_property
    def outside(self) -> Array:
        """(6 N, 6 N) what both add to ``covariance``."""
        return self.travel @ self.travel.T + self.by_lidars @ self.by_lidars.T

    @property
    def mount(self) -> ErrorFit | None:
        """The fit of the mounts, between which images and measurements show relative poses."""
        return None if self.error_fit is None else self.error_fit.of_mount

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph whose optimum and marginal are reported; with the paper's presets, Eq. 5."""
        if self.error_fit is not None and self.config.preset == "auto":
            return latent_pose_graph(self.error_fit.model)
        return self.inliers.graph(self.scales)

    def error_sources(self, joint: Array) -> dict[str, ErrorSources]:
        """Per camera with an error bar, the shares of its sources.

        Args:
            joint: (6 N, 6 N) the reported covariance, which may be wider than that of the matches.
        """
        if self.error_fit is None:
            return {}
        columns = self.travel, self.by_lidars
        return error_sources(self.error_fit, joint, columns, self.held)

    @cached_property
    def pair_terms(self) -> tuple[PairTerm, ...]:
        """What cameras see in common, with surfaces as here; frames of one stop are one."""
        if self.camera_matches is None:
            return ()
        frame = self.correspondences.places.merge_stationary(self.camera_matches.frame)
        rig, matches = self.rig.moved_to(self.T_camera_lidar), self.camera_matches
        return pair_terms(rig, replace(matches, frame=frame))

    @cached_property
    def pairs_alone(self) -> Places:
        """Where pairs place their cameras, held near the estimate."""
        return place_pairs(self.pair_terms, self.T_camera_lidar)

    @cached_property
    def pair_fits(self) -> list[PairFit]:
        """The relative poses of pairs by images, the first camera held near its correspondences."""
        if self.alone is not None:
            return self.alone.pair_fits
        if (joint := self.covariance) is None:
            return []
        rows = map(pose_rows, range(len(self.fitted.cameras)))
        held = np.array([joint[own, own] for own in rows])
        return fit_pairs(self.pair_terms, self.T_camera_lidar, held, self.pairs_alone)

    @cached_property
    def conflicts(self) -> tuple[Conflict, ...]:
        """The factors of relative poses between cameras that both have correspondences.

        None where these determine no pose without the factors: then nothing contradicts them.
        """
        measured, cameras = self.inliers.rig.relative_poses, self.inliers.blocks
        pairs = [pair for pair in measured if {pair.a, pair.b} <= cameras.keys()]
        if not pairs:
            return ()
        free = None if self.error_fit is None else self.error_fit.without_priors
        table = self.correspondences
        free = free or fit_without_priors(self.fitted, table.findings, table.places)
        if free is None:
            return ()
        mount = free.of_mount
        names, T, covariance = mount.model.cameras, mount.T_camera_lidar, mount.covariance
        return tuple(relative_pose_conflict(pair, names, T, covariance) for pair in pairs)

    def without_pairs(self) -> Solution:
        """The solution without what cameras see in common."""
        return self.alone or self
