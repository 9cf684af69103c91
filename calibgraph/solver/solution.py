"""What the joint solve returns: the optimum, and everything that checks of it need."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam

from calibgraph.arrays import Array
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config, Terms
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.lens import LensEstimate
from calibgraph.model.rig import Rig
from calibgraph.solver.curvature import FittedObjective
from calibgraph.solver.error_model import ErrorFit
from calibgraph.solver.lens import lens_covariances, lens_estimates, moved_lenses, put_into
from calibgraph.solver.marginals import Marginals
from calibgraph.solver.objective import Objective, Scales, Transforms
from calibgraph.solver.optimizer import Optimum


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
        before_pairs: the optimum without it; None if no pair of cameras had enough.
        held: cameras that nothing determines; they stay where the rig has them.
        errors: the error model that the optimum is of; None where it is that of the objective.
        errors_before_pairs: likewise, of ``before_pairs``.
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
    before_pairs: Optimum | None = None
    held: tuple[str, ...] = ()
    errors: ErrorFit | None = None
    errors_before_pairs: ErrorFit | None = None

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
        fit = None if self.errors is None else self.errors.fit
        lenses, _ = moved_lenses(self.inliers.lenses, fit)
        return put_into(self.rig.moved_to(self.T_camera_lidar), lenses)

    @property
    def lens(self) -> dict[str, tuple[LensEstimate, ...]]:
        """Per camera whose lens is estimated, its parameters."""
        return {} if self.errors is None else lens_estimates(self.errors.fit)

    @property
    def lens_covariance(self) -> dict[str, Array]:
        """Per camera whose lens is estimated, (6 + k, 6 + k) of pose, lens and clock."""
        return {} if self.errors is None else lens_covariances(self.errors.fit)

    @cached_property
    def marginals(self) -> Marginals:
        """Its covariance, and all that it is made of."""
        alone = None if self.before_pairs is None else self.without_pairs().marginals
        return Marginals(self.fitted, self.correspondences, self.errors, self.camera_matches, alone)

    @property
    def covariance(self) -> Array | None:
        """(6 N, 6 N) of all extrinsics, in the rig's order; None if a direction is undetermined.

        Of xi in T_camera_lidar = exp(xi) estimate, xi = (rotation [rad], translation [m]).
        """
        return self.marginals.covariance

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph whose optimum and marginal are reported."""
        return self.marginals.graph

    def without_pairs(self) -> Solution:
        """The solution without what cameras see in common."""
        return self._alone

    @cached_property
    def _alone(self) -> Solution:
        if self.before_pairs is None:
            return self
        alone = replace(self.inliers, pairs=())
        return replace(
            self,
            inliers=alone,
            optimum=self.before_pairs,
            before_pairs=None,
            errors=self.errors_before_pairs,
            errors_before_pairs=None,
        )
