"""What checks share of a solution: its error bars."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.run import MatchingRun
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import pair_covariances, pose_rows, twist_between
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.solution import Solution
from calibgraph.trust.pose_posterior import PosePosterior, group_tied, measure_posteriors, widen
from calibgraph.trust.probability import probability_beyond
from factors import pose_sigmas

Found = Iterator[tuple[str, Check]]
"""Checks, each with its camera."""
Checks = Mapping[str, Sequence[Check]]
"""Per camera, its checks."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """A solution and what its checks share.

    Attributes:
        solution: with its marginals.
        guess: the rig as it was first guessed.
        posteriors: per camera of :attr:`tied` whose images were scored, that of its pose by these.
        excluded: cameras that the user excluded; the solution may have excluded more.
    """

    solution: Solution
    guess: Rig
    posteriors: Mapping[str, PosePosterior] = field(default_factory=dict)
    excluded: tuple[str, ...] = ()

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the rig's order."""
        return tuple(self.solution.T_camera_lidar)

    @property
    def found(self) -> dict[str, Array]:
        """Per camera that no search has missed, the (4, 4) T_camera_lidar."""
        T, missed = self.solution.T_camera_lidar, self.findings.missed
        return {name: T[name] for name in T if name not in missed}

    @property
    def findings(self) -> MatcherFindings:
        """The findings of the matcher."""
        return self.solution.correspondences.findings

    @property
    def fitted_blocks(self) -> Mapping[str, CameraBlock]:
        """Per camera, the correspondences of pass 1, before the gate; none of outlier frames."""
        objective = self.solution.objective
        return objective.blocks if objective.uses_correspondences else {}

    @cached_property
    def tied(self) -> list[tuple[str, ...]]:
        """The cameras that are not held, in groups that can only be elsewhere together.

        A measured pose that contradicts the matches ties nothing.
        """
        solution, limit = self.solution, error_components().contradiction_sigmas
        free = [name for name in self.cameras if name not in solution.held]
        wrong = {(one.pair.a, one.pair.b) for one in solution.conflicts if one.largest > limit}
        ties = [(fit.a, fit.b, fit.covariance) for fit in solution.pair_fits]
        for one in solution.inliers.rig.relative_poses:
            sigmas = pose_sigmas(
                rotation_rad=one.rotation_sigma_rad, translation_m=one.translation_sigma_m
            )
            if (one.a, one.b) not in wrong:
                ties.append((one.a, one.b, np.diag(sigmas**2)))
        return group_tied(free, ties)

    @cached_property
    def joint_covariance(self) -> Array | None:
        """(6 N, 6 N) by matches and images, the wider one, and by what is outside of both.

        That is an unknown motion of the vehicle, and the poses of other LiDARs. Cameras that are
        held are unknown.
        """
        known = self.solution.covariance
        return None if known is None else self._widen(known) + self.solution.outside

    def _widen(self, joint: Array) -> Array:
        """(6 N, 6 N): a covariance, widened where the images' evidence is flat."""
        found = self.posteriors.items()
        return widen(joint, {self.cameras.index(name): of.moments for name, of in found})

    @property
    def error_sources(self) -> dict[str, ErrorSources]:
        """Per camera with an error bar, the shares of its sources."""
        joint = self.joint_covariance
        return {} if joint is None else self.solution.error_sources(joint)

    def probability_beyond(self, camera: str) -> float:
        """The probability that its error is beyond the tolerance, by its posterior."""
        own, found = self.covariance_by_matches(camera), self.posteriors.get(camera)
        tolerance = self.solution.config.tolerance
        if own is None or found is None or self.solution.outside.any():
            return probability_beyond(self.covariance_of(camera), tolerance)
        return found.probability_beyond(own, tolerance)

    def covariance_of(self, camera: str) -> Array | None:
        """(6, 6) of one camera, with the error that all the matcher's frames share."""
        return self._rows_of(self.joint_covariance, camera)

    def covariance_by_matches(self, camera: str) -> Array | None:
        """(6, 6) of one camera, not widened by what the images leave open."""
        known = self.solution.covariance
        return self._rows_of(None if known is None else known + self.solution.outside, camera)

    def _rows_of(self, joint: Array | None, camera: str) -> Array | None:
        if joint is None or camera in self.solution.held:
            return None
        rows = pose_rows(self.cameras.index(camera))
        return joint[rows, rows]

    def pair_covariances(self) -> dict[str, Array]:
        """Per pair "A->B", (6, 6): by second moments of the mounts about the solution, widened."""
        mount, T = self.solution.mount, self.solution.T_camera_lidar
        if mount is None:
            return {}
        away = np.concatenate([twist_between(mount.T_camera_lidar[name], T[name]) for name in T])
        joint = self._widen(mount.covariance + np.outer(away, away))
        joint += self.solution.outside
        return pair_covariances(joint, T, self.solution.held)


def gather_of_run(run: MatchingRun, *, asks_guess: bool = False) -> Evidence:
    """The evidence of a run's solution, with posteriors if its matcher uses what these scores do.

    ``asks_guess``: whether the guess is a pose in question, as in ``check``.
    """
    solution = run.solution
    evidence, known = Evidence(solution, run.guess, excluded=run.excluded), solution.covariance
    if known is None or run.out_of_time or not run.matcher.image_checks_can_fail:
        return evidence
    rows = {name: pose_rows(number) for number, name in enumerate(evidence.cameras)}
    posteriors = measure_posteriors(
        run.dataset,
        solution.solved_rig,
        {name: known[own, own] for name, own in rows.items()},
        evidence.tied,
        asked=run.guess.T_camera_lidar if asks_guess else None,
        seed=solution.config.seed,
    )
    return replace(evidence, posteriors=posteriors)


def grade_by_images(run: MatchingRun, check: Check) -> Check:
    """A check on images, not a FAIL where those of the run's matcher WARN at most."""
    warns = check.status == "FAIL" and not run.matcher.image_checks_can_fail
    return replace(check, status="WARN") if warns else check


def by_camera(cameras: Iterable[str], *parts: Found) -> dict[str, list[Check]]:
    """Per camera the checks of all parts, one part after the other."""
    checks: dict[str, list[Check]] = {name: [] for name in cameras}
    for name, check in chain(*parts):
        checks[name].append(check)
    return checks
