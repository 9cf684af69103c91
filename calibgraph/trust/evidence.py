"""What checks share of a solution: its error bars, made once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.run import MatchingRun
from calibgraph.model.config import Terms
from calibgraph.model.error_sources import ErrorSources
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import pair_covariances, pose_rows, twist_between
from calibgraph.model.lens import LensEstimate
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.solver.error_model import Conflict
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.solution import Solution
from calibgraph.trust.pose_posterior import (
    MeasurePosteriors,
    PosePosterior,
    group_tied,
    measure_posteriors,
    widen,
)
from calibgraph.trust.probability import probability_beyond
from factors import pose_sigmas

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
        is_free: whether its correspondences do not determine it.
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
    conflicts: tuple[Conflict, ...]
    converged: bool = True
    terms: Terms = "full"
    held: bool = False
    excluded: bool = False
    scatter_only: bool = False
    tolerance: tuple[float, float] = TOLERANCE
    lens: tuple[LensEstimate, ...] = ()
    is_free: bool = False


@dataclass(frozen=True, eq=False)
class Evidence:
    """A solution and what its checks share, by :func:`gather`.

    Attributes:
        solution: with its marginals.
        guess: the rig as it was first guessed.
        excluded: cameras that the user excluded; the solution may have excluded more.
        tied: the free cameras, in groups that can only be elsewhere together.
        posteriors: per free camera whose images were scored, that of its pose by these.
    """

    solution: Solution
    guess: Rig
    excluded: tuple[str, ...]
    tied: Sequence[tuple[str, ...]]
    posteriors: Mapping[str, PosePosterior]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Their names, in the rig's order."""
        return tuple(self.solution.T_camera_lidar)

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


def gather(
    solution: Solution,
    guess: Rig,
    measure: MeasurePosteriors | None = None,
    *,
    excluded: tuple[str, ...] = (),
) -> Evidence:
    """The evidence of a solution.

    Args:
        solution: of a table.
        guess: the rig as it was first guessed.
        measure: gives the posteriors by the images; None: there are no images.
        excluded: cameras that the user excluded.
    """
    cameras = tuple(solution.T_camera_lidar)
    tied, known = _tied(solution), solution.covariance
    if known is None or measure is None:
        return Evidence(solution, guess, excluded, tied, {})
    rows = {name: pose_rows(number) for number, name in enumerate(cameras)}
    own = {name: known[rows[name], rows[name]] for group in tied for name in group}
    return Evidence(solution, guess, excluded, tied, measure(own, tied))


def _tied(solution: Solution) -> list[tuple[str, ...]]:
    """The free cameras in groups; a measured pose that contradicts the matches ties nothing."""
    free = [name for name in solution.T_camera_lidar if name not in solution.held]
    limit, known = error_components().contradiction_sigmas, solution
    wrong = {(one.pair.a, one.pair.b) for one in known.conflicts if one.largest > limit}
    poses = solution.inliers.rig.relative_poses
    right = [one for one in poses if (one.a, one.b) not in wrong]
    ties = [(fit.a, fit.b, fit.covariance) for fit in known.pair_fits]
    for one in right:
        sigmas = pose_sigmas(
            rotation_rad=one.rotation_sigma_rad, translation_m=one.translation_sigma_m
        )
        ties.append((one.a, one.b, np.diag(sigmas**2)))
    return group_tied(free, ties)


def gather_of_run(run: MatchingRun, *, asks_guess: bool = False) -> Evidence:
    """The evidence of a run's solution, with posteriors if its matcher uses what these scores do.

    ``asks_guess``: whether the guess is a pose in question, as in ``check``.
    """
    measure: MeasurePosteriors | None = None
    if run.matcher.image_checks_can_fail and not run.out_of_time:
        asked = run.guess.T_camera_lidar if asks_guess else None
        rig, seed = run.solution.solved_rig, run.solution.config.seed
        measure = partial(measure_posteriors, run.dataset, rig, asked=asked, seed=seed)
    return gather(run.solution, run.guess, measure, excluded=run.excluded)


def grade_by_images(run: MatchingRun, checks: Checks) -> Checks:
    """Checks on images, without a FAIL where those of the run's matcher WARN at most."""
    if run.matcher.image_checks_can_fail:
        return checks
    return {
        name: [replace(c, status="WARN") if c.status == "FAIL" else c for c in of_camera]
        for name, of_camera in checks.items()
    }


def concatenate(parts: Sequence[Checks], cameras: Sequence[str]) -> dict[str, list[Check]]:
    """Per camera the checks of all parts, one part after the other."""
    return {name: [check for part in parts for check in part.get(name, ())] for name in cameras}
