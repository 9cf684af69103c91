"""The covariance of a solution, and all that it is made of: the marginal of the error model.

With the preset ``auto`` the estimate is the optimum of that model. With the paper's presets the
estimate is the minimum of Eq. 5, and the model serves for its covariance alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.graph.latent_poses import latent_pose_graph
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.conflicts import Conflict, relative_pose_conflict
from calibgraph.solver.covariance import FittedObjective, data_sigmas
from calibgraph.solver.error_model import fit_errors, fit_without_priors
from calibgraph.solver.pair_refinement import PairFit, fit_pairs, shared_variance_ratio
from calibgraph.solver.places import ErrorFit
from calibgraph.solver.sources import predict_variances, sources_by_camera, variances_by_source
from factors import pose_sigmas

_HELD_RAD, _HELD_M = np.radians(0.1), 0.02  # a camera, if its covariance is unknown


@dataclass(frozen=True, eq=False)
class Marginals:
    """The covariance of a solution and its parts, each computed once, when it is needed.

    Attributes:
        at: the solution's objective, at its estimate.
        table: the correspondences, with the matcher's error and the places.
        fit: the error model that the estimate is of; None where it is that of the objective.
        camera_matches: what cameras see in common.
        alone: those of the solution without camera pairs; None where there are none.
    """

    at: FittedObjective
    table: Correspondences
    fit: ErrorFit | None = None
    camera_matches: CameraMatches | None = None
    alone: Marginals | None = None

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the rig's order."""
        return self.at.cameras

    @property
    def findings(self) -> MatcherFindings:
        """The findings of the matcher."""
        return self.table.findings

    @cached_property
    def covariance(self) -> Array | None:
        """(6 N, 6 N): the marginal of the error model."""
        return None if self.errors is None else self.errors.covariance

    @cached_property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph whose optimum and marginal they are; with the paper's presets, Eq. 5."""
        if self.errors is not None and self.at.objective.config.preset == "auto":
            return latent_pose_graph(self.errors.model)
        return self.at.objective.graph(self.at.scales)

    @cached_property
    def errors(self) -> ErrorFit | None:
        """The error model of the solution; None as of ``fit_errors``.

        The shared error is at least as large as pairs of images show, even if the loss rejects
        them.
        """
        found = self.fit or fit_errors(self.at, self.findings, self.table.places)
        return None if found is None else found.with_shared_ratio(self.shared_variance_ratio)

    @cached_property
    def data_sigmas(self) -> Array | None:
        """(N, 6) standard deviations if every correspondence were independent."""
        if not self.at.objective.uses_correspondences:
            return None
        return data_sigmas(self.at)

    def error_sources(self, joint: Array) -> dict[str, ErrorSources]:
        """Per camera with an error bar, the shares of its sources.

        Args:
            joint: (6 N, 6 N) the reported covariance, which may be wider than that of the matches.
        """
        if self.errors is None:
            return {}
        total, held = np.diag(self.errors.covariance), self.at.held
        parts, forecast = variances_by_source(self.errors), predict_variances(self.errors)
        numbers = {n: k for k, n in enumerate(self.cameras) if n not in held}
        return sources_by_camera(joint, total, parts, forecast, numbers=numbers)

    @cached_property
    def shared_variance_ratio(self) -> float:
        """Variance of the shared error relative to its prior, from co-visible features."""
        mount = None if self.alone is None else self.alone.mount
        if self.alone is None or mount is None:
            return 1.0
        return shared_variance_ratio(mount.T_camera_lidar, mount.covariance, self.alone.pair_fits)

    @property
    def mount(self) -> ErrorFit | None:
        """The fit of the mounts, between which images and measurements show relative poses."""
        return None if self.errors is None else self.errors.of_mount

    @cached_property
    def pair_fits(self) -> list[PairFit]:
        """The relative poses of pairs by images, the first camera held near its correspondences."""
        return self.fit_pairs_near(self.covariance) if self.alone is None else self.alone.pair_fits

    def fit_pairs_near(self, joint: Array | None) -> list[PairFit]:
        """The same, the first camera held by some (6 N, 6 N) covariance."""
        if self.camera_matches is None:
            return []
        known = self.known_or_prior(joint)
        held = [known[pose_rows(number), pose_rows(number)] for number in range(len(self.cameras))]
        rig = self.at.objective.rig.moved_to(self.at.T_camera_lidar)
        return fit_pairs(rig, self.camera_matches, self.at.objective.config, np.array(held))

    def known_or_prior(self, joint: Array | None) -> Array:
        """(6 N, 6 N) covariance of the solution; a prior where it is not determined."""
        if joint is not None:
            return joint
        held = pose_sigmas(rotation_rad=_HELD_RAD, translation_m=_HELD_M) ** 2
        return np.diag(np.tile(held, len(self.cameras)))

    @cached_property
    def conflicts(self) -> tuple[Conflict, ...]:
        """The factors of relative poses between cameras that both have correspondences.

        None where these determine no pose without the factors: then nothing contradicts them.
        """
        cameras = tuple(self.at.objective.blocks)
        measured = self.at.objective.rig.relative_poses
        pairs = [pair for pair in measured if pair.a in cameras and pair.b in cameras]
        if not pairs:
            return ()
        free = None if self.errors is None else self.errors.without_priors
        free = free or fit_without_priors(self.at, self.findings, self.table.places)
        if free is None:
            return ()
        mount = free.of_mount
        names, T, covariance = mount.model.cameras, mount.T_camera_lidar, mount.covariance
        return tuple(relative_pose_conflict(pair, names, T, covariance) for pair in pairs)
