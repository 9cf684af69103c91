"""The values that checks share, each computed once, when the first check needs it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.run import MatchingRun
from calibgraph.model.calibration import Residuals
from calibgraph.model.config import Terms
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import pose_rows, twist_between
from calibgraph.model.lens import LensEstimate
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.progress import Progress, no_progress
from calibgraph.solver.conflicts import Conflict
from calibgraph.solver.covariance import bootstrap_covariances
from calibgraph.solver.matches import BlockResiduals, CameraBlock
from calibgraph.solver.pair_refinement import PairFit
from calibgraph.solver.solution import Solution
from calibgraph.trust.observability import prior_shares
from calibgraph.trust.pose_posterior import (
    ImagePosteriors,
    MeasurePosteriors,
    PosePosterior,
    group_tied,
    measure_posteriors,
    measured_pairs,
    no_posteriors,
)

Checks = Mapping[str, Sequence[Check]]
"""Per camera, its checks; a camera without any may be left out."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """One camera's estimate and the values that its checks need, from a batch or while driving.

    Attributes:
        has_matches: whether it had correspondences; else it was solved through relative poses.
        used: correspondences in the final solve.
        frames: frames that they come from.
        covariance: (6, 6) of (rotation [rad], translation [m]), or None.
        data_sigmas: (6,) the standard deviations if every correspondence were independent, or None.
        conflicts: of the relative poses that name this camera.
        held: whether nothing determines it.
        excluded: whether the settings exclude its correspondences.
        scatter_only: whether it is unknown how large the error is that all frames share.
        tolerance: of the user: rotation [deg] and distance [cm].
        lens: the parameters of lens and clock that were estimated.
    """

    has_matches: bool
    used: int
    frames: int
    covariance: Array | None
    data_sigmas: Array | None
    conflicts: tuple[Conflict, ...]
    converged: bool = True
    terms: Terms = "full"
    held: bool = False
    excluded: bool = False
    scatter_only: bool = False
    tolerance: tuple[float, float] = TOLERANCE
    lens: tuple[LensEstimate, ...] = ()


@dataclass(frozen=True, eq=False)
class Evidence:
    """A solution, the rig as it was first guessed, and the values that checks compute from them.

    ``excluded`` are the cameras that the user excluded; the solution may have excluded more.
    """

    solution: Solution
    guess: Rig
    measure_posteriors: MeasurePosteriors = no_posteriors
    excluded: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the rig's order."""
        return tuple(self.solution.T_camera_lidar)

    @cached_property
    def of_correspondences(self) -> Evidence:
        """The evidence of the solution without camera-to-camera matches."""
        if self.solution.before_pairs is None:
            return self
        return Evidence(self.solution.without_pairs(), self.guess, excluded=self.excluded)

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
        poses, scales = self.solution.T_camera_lidar, self.solution.scales
        blocks = self.solution.objective.blocks.items()
        return {n: BlockResiduals.at(poses[n], block).summary(scales[n]) for n, block in blocks}

    @cached_property
    def joint_covariance(self) -> Array | None:
        """(6 N, 6 N): of the matches, widened where the images' evidence is flat.

        Cameras that are held are unknown by a radian and a metre.
        """
        known = self.covariance_of_matches
        return None if known is None else self._beside_images.widen(known)

    @property
    def mount_covariance(self) -> Array | None:
        """(6 N, 6 N) second moments of the mounts about the solution, widened alike."""
        mount = self.solution.marginals.mount
        if mount is None:
            return None
        of, T = mount.T_camera_lidar, self.solution.T_camera_lidar
        away = np.concatenate([twist_between(of[name], T[name]) for name in T])
        return self._beside_images.widen(mount.covariance + np.outer(away, away))

    @property
    def _beside_images(self) -> ImagePosteriors:
        known = self.covariance_of_matches
        assert known is not None  # asked by those who have one
        return ImagePosteriors(self.cameras, known, self.posteriors)

    @property
    def flatness(self) -> dict[str, Check]:
        """Per camera with a posterior, the check whether the images leave its pose more open."""
        return self._beside_images.check_flatness() if self.posteriors else {}

    @cached_property
    def posteriors(self) -> Mapping[str, PosePosterior]:
        """Per free camera, its posterior by the images' evidence."""
        if (known := self.covariance_of_matches) is None:
            return {}
        own = {name: self._rows_of(known, name) for group in self.tied for name in group}
        return self.measure_posteriors(own, self.tied)

    @cached_property
    def tied(self) -> list[tuple[str, ...]]:
        """The free cameras, in groups that can only be elsewhere together.

        A measured relative pose that contradicts the correspondences ties nothing.
        """
        free = [name for name in self.cameras if name not in self.solution.held]
        limit, known = error_components().contradiction_sigmas, self.solution.marginals
        wrong = {(one.pair.a, one.pair.b) for one in known.conflicts if one.largest > limit}
        poses = self.solution.inliers.rig.relative_poses
        right = [one for one in poses if (one.a, one.b) not in wrong]
        by_images = [(fit.a, fit.b, fit.covariance) for fit in known.pair_fits]
        return group_tied(free, [*by_images, *measured_pairs(right)])

    def probability_beyond(self, camera: str) -> float:
        """The probability that its error is beyond the tolerance, by its posterior."""
        if camera in self.solution.held or self.covariance_of_matches is None:
            return 0.0
        return self._beside_images.probability_beyond(camera, self.solution.config.tolerance)

    @property
    def covariance_of_matches(self) -> Array | None:
        """(6 N, 6 N): the marginal of the solution's graph."""
        return self.solution.marginals.covariance

    @property
    def error_sources(self) -> dict[str, ErrorSources]:
        """Per camera with an error bar, the shares of its sources."""
        joint = self.joint_covariance
        return {} if joint is None else self.solution.marginals.error_sources(joint)

    @cached_property
    def pair_fits(self) -> list[PairFit]:
        """The relative poses of pairs by images, the first camera held near the solution."""
        marginals, joint = self.solution.marginals, self.joint_covariance
        return marginals.pair_fits if not self.posteriors else marginals.fit_pairs_near(joint)

    def covariance_of(self, camera: str) -> Array | None:
        """(6, 6) of one camera, with the error that all the matcher's frames share."""
        return self._block(self.joint_covariance, camera)

    def covariance_by_matches(self, camera: str) -> Array | None:
        """(6, 6) of one camera, not widened by what the images leave open."""
        return self._block(self.covariance_of_matches, camera)

    @property
    def lens_covariance(self) -> dict[str, Array]:
        """Per camera whose lens is estimated, (6 + k, 6 + k): the pose's part is ``covariance_of``.

        What widens that beyond the solution's graph is not correlated with the lens.
        """
        found = self.solution.lens_covariance
        for name, joint in found.items():
            if (own := self.covariance_of(name)) is not None:
                joint[:6, :6] = own
        return found

    def _block(self, joint: Array | None, camera: str) -> Array | None:
        held = camera in self.solution.held
        return None if joint is None or held else self._rows_of(joint, camera)

    def _rows_of(self, joint: Array, camera: str) -> Array:
        """(6, 6) of one camera, of the (6 N, 6 N) of all."""
        rows = pose_rows(self.cameras.index(camera))
        return joint[rows, rows]

    @cached_property
    def bootstrap(self) -> dict[str, Array]:
        """Per camera (6, 6) scatter of re-solves from frames drawn again; empty if not wanted."""
        config = self.solution.config
        return bootstrap_covariances(self.solution.fitted, config.bootstrap, config.seed)

    @cached_property
    def prior_shares(self) -> dict[str, float]:
        """Per camera, which share of its result comes from priors and relative poses."""
        return prior_shares(self.solution)

    def estimate(self, camera: str) -> Estimate:
        """The input of the checks of one camera's estimate.

        Of the matches alone: where the images are flat, the error bar says so, and no check fails.
        """
        solution, block = self.solution, self.solution.inliers.blocks.get(camera)
        sigmas, conflicts = solution.marginals.data_sigmas, solution.marginals.conflicts
        return Estimate(
            has_matches=camera in solution.objective.blocks,
            used=0 if block is None else len(block.frame),
            frames=0 if block is None else len(block.frame_edges) - 1,
            covariance=self.covariance_by_matches(camera),
            data_sigmas=None if sigmas is None else sigmas[self.cameras.index(camera)],
            conflicts=tuple(c for c in conflicts if camera in (c.pair.a, c.pair.b)),
            converged=solution.optimum.converged,
            terms=solution.terms,
            held=camera in solution.held,
            excluded=camera in self.excluded,
            scatter_only=not self.findings.states_common_error,
            tolerance=solution.config.tolerance,
            lens=solution.lens.get(camera, ()),
        )


@dataclass(frozen=True, eq=False)
class RunEvidence:
    """All rounds of matching and solving, and the SHA-256 of the files they read.

    ``asks_guess``: whether the guess is a pose in question, as in ``check``.
    """

    run: MatchingRun
    hashes: Mapping[str, str]
    progress: Progress = no_progress
    asks_guess: bool = False

    @cached_property
    def solution(self) -> Evidence:
        """The evidence of the last round's solution."""
        run = self.run
        return Evidence(run.solution, run.guess, self._measure_posteriors, run.excluded)

    def grade_by_images(self, checks: Checks) -> Checks:
        """Checks on images, without a FAIL where those of the run's matcher WARN at most."""
        if self.run.matcher.image_checks_can_fail:
            return checks
        return {
            name: [replace(c, status="WARN") if c.status == "FAIL" else c for c in of_camera]
            for name, of_camera in checks.items()
        }

    def _measure_posteriors(
        self, covariances: Mapping[str, Array], groups: Sequence[Sequence[str]]
    ) -> Mapping[str, PosePosterior]:
        """By the images; empty with matchers that may use what these scores do not."""
        run = self.run
        if run.out_of_time or not run.matcher.image_checks_can_fail:
            return {}
        asked = run.guess.T_camera_lidar if self.asks_guess else None
        data, rig, seed = run.dataset, run.solution.solved_rig, run.solution.config.seed
        return measure_posteriors(data, rig, covariances, groups, asked=asked, seed=seed)


def concatenate(parts: Sequence[Checks], cameras: Sequence[str]) -> dict[str, list[Check]]:
    """Per camera the checks of all parts, one part after the other."""
    return {name: [check for part in parts for check in part.get(name, ())] for name in cameras}
