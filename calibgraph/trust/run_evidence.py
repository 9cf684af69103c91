"""A whole run of matching and solving, and the values that its checks compute from the images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from calibgraph.arrays import Array
from calibgraph.matching.run import MatchingRun
from calibgraph.progress import Progress, no_progress
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.pose_posterior import PosePosterior, measure_posteriors


@dataclass(frozen=True, eq=False)
class RunEvidence:
    """All rounds of matching and solving, and the SHA-256 of the files they read.

    Attributes:
        run: of the rounds.
        hashes: per file.
        progress: called as images are scored.
        asks_guess: whether the guess is a pose in question, as in ``check``.
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
        seed = run.solution.config.seed
        return measure_posteriors(
            run.dataset,
            run.solution.solved_rig,
            covariances,
            groups,
            asked=run.guess.T_camera_lidar if self.asks_guess else None,
            seed=seed,
        )
