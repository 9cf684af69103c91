"""One camera's older epochs in constant size: their sums, discounted by a random walk.

Several walks are kept side by side: static, and a few strengths of drift. Each predicts every new
epoch; the log-likelihoods of these predictions are its evidence, and the best one is selected.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.sums import Sums

STRENGTHS = np.array([0.0, 0.2, 1.0, 5.0])
"""The walks, in units of the configured one; the first is static."""

_EVIDENCE_KEPT = 0.98  # of the log-likelihood, from one epoch to the next: half in 34 epochs
_DISTANCE_CAP = 24.0  # squared sigmas of one epoch: so that a single outlier decides nothing
_SELECT_WALK = 12.0  # log-likelihood by which a walk must exceed the static model
_SELECT_STATIC = 12.0  # by which the static model must exceed the walk it started from
_PREFER_WALK = 3.0  # by which another strength must exceed the present one
_LEAST_FRAMES = 4.0  # for a prediction


@dataclass(frozen=True, eq=False)
class EpochSummary:
    """Sums over one camera's older epochs, for every walk.

    Attributes:
        walks: (w,) sums, each discounted by its walk.
        evidence: (w,) log-likelihoods of the epochs, forgotten slowly.
        walk: which of the walks is selected.
        ungated: of all matches, outliers too: Hessian by their weights, and gradient.
    """

    walks: Sums
    evidence: Array
    walk: int
    ungated: Sums

    @staticmethod
    def empty() -> EpochSummary:
        """Over no epochs."""
        w = len(STRENGTHS)
        return EpochSummary(Sums.zeros(w), np.zeros(w), 0, Sums.zeros())

    def shift_reference(self, step: Array) -> EpochSummary:
        """The sums about a reference that is moved by a tangent step."""
        walks, ungated = (sums.shift_reference(step) for sums in (self.walks, self.ungated))
        return changed(self, walks=walks, ungated=ungated)

    def add(self, epoch: Sums, ungated: Sums) -> EpochSummary:
        """The sums with an epoch's added, taken at the same reference."""
        return changed(self, walks=self.walks + epoch, ungated=self.ungated + ungated)

    def propagate(self, variance: Array, overconfidence: float) -> EpochSummary:
        """The sums after the random walk of an epoch.

        Args:
            variance: (w, 6) of the walks over the epoch.
            overconfidence: of the Hessian, see ``calibgraph.tracking.sums``.
        """
        walks, kept = self.walks.after_walk(variance, overconfidence)
        return changed(self, walks=walks, ungated=self.ungated * kept[self.walk])

    def update_evidence(self, epoch: Sums, noise: Array) -> EpochSummary:
        """The summary with the walks' evidence updated by how well each predicts an epoch.

        Args:
            epoch: its sums.
            noise: (6, 6) covariance of such a gradient at the true extrinsic.
        """
        walks = self.walks
        if not (walks.frames >= _LEAST_FRAMES).all():
            return self
        steps = np.linalg.solve(walks.hessian, -walks.gradient[..., None])[..., 0]
        score = epoch.gradient + steps @ epoch.hessian
        spread = np.linalg.solve(walks.hessian, epoch.hessian[None])
        covariance = noise + spread.transpose(0, 2, 1) @ walks.scatter @ spread
        whitened = np.linalg.solve(covariance, score[..., None])[..., 0]
        distance = (score * whitened).sum(axis=1)
        logarithm = np.linalg.slogdet(covariance)[1]
        logarithm = logarithm - logarithm.min()
        gain = -0.5 * (np.minimum(distance, _DISTANCE_CAP) + logarithm)
        return changed(self, evidence=_EVIDENCE_KEPT * self.evidence + gain)

    def select_walk(self) -> EpochSummary:
        """The summary with the walk selected by the evidence.

        During a drift the static sums become outdated. Whenever the evidence is against them, they
        restart from those of the walk, and must gain evidence from there.
        """
        best = self.best_walk
        if self.walk == 0:
            if self.evidence[best] - self.evidence[0] <= _SELECT_WALK:
                return self
            return self.with_walk(best)
        if self.evidence[0] - self.evidence[self.walk] > _SELECT_STATIC:
            return changed(self, walk=0, evidence=np.zeros_like(self.evidence))
        walk = self.walk
        if self.evidence[best] - self.evidence[walk] > _PREFER_WALK:
            walk = best
        summary = changed(self, walk=walk)
        if self.evidence[walk] - self.evidence[0] > _PREFER_WALK:
            summary = summary._restart_static_from(walk)
        return summary

    @property
    def selected(self) -> Sums:
        """The sums of the selected walk."""
        return self.walks[self.walk]

    @property
    def best_walk(self) -> int:
        """The walk with the most evidence, the static one left out."""
        return 1 + int(np.argmax(self.evidence[1:]))

    def with_walk(self, walk: int) -> EpochSummary:
        """The summary with a walk selected, whose evidence begins anew."""
        new = changed(self, walk=walk, evidence=np.zeros_like(self.evidence))
        return new._restart_static_from(walk)

    def _restart_static_from(self, walk: int) -> EpochSummary:
        """The summary with the static sums restarted from those of a walk."""
        evidence = self.evidence.copy()
        evidence[0] = evidence[walk]
        return changed(self, walks=self.walks.replace_at(0, self.walks[walk]), evidence=evidence)
