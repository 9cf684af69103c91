"""One camera's older epochs in constant size: sums of quadratics, discounted by a random walk.

Near a reference T_lidar_camera, half the cost of a block of correspondences is
``d^T H d / 2 + b^T d + c`` for the tangent step d from the reference. Such sums add: thousands of
frames are one (H, b). H is the true Hessian of the robust cost: with it the step to the minimum is
exact to second order, while with the reweighted Hessian it is 20 to 40 percent too short. The
scatter ``B = sum g g^T`` of the frames' gradients is summed too: ``H^-1 B H^-1`` is the covariance.

If the extrinsic may have walked by a covariance Q since, then

    H' = (H^-1 + Q / k)^-1 = G H,   b' = G b,   B' = G B G^T + H' Q H'

so that ``H'^-1 B' H'^-1 = H^-1 B H^-1 + Q`` exactly, whatever the gain. k, the mean eigenvalue of
``H^-1 B`` per frame, is the overconfidence of H: matches of a frame share errors.

Several walks are kept side by side: static, and a few strengths of drift. Each predicts every new
epoch; the log-likelihoods of these predictions are its evidence, and the best one is selected.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

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
        hessian: (w, 6, 6) sum of the frames' true Hessians, in the tangent of T_lidar_camera.
        gradient: (w, 6) at the reference, which ``State`` holds.
        scatter: (w, 6, 6) sum of the outer products of the frames' gradients, and the walk.
        frames: (w,) how many frames that is, after forgetting.
        evidence: (w,) log-likelihoods of the epochs, forgotten slowly.
        walk: which of the walks is selected.
        halves_hessian, halves_gradient: (2, 6, 6) and (2, 6) of every other epoch.
        next_half: which of the two the next epoch is added to.
        ungated_hessian, ungated_gradient: (6, 6) and (6,) of all matches, outliers too.
    """

    hessian: Array
    gradient: Array
    scatter: Array
    frames: Array
    evidence: Array
    walk: int
    halves_hessian: Array
    halves_gradient: Array
    next_half: int
    ungated_hessian: Array = field(default_factory=lambda: np.zeros((6, 6)))
    ungated_gradient: Array = field(default_factory=lambda: np.zeros(6))

    @staticmethod
    def empty() -> EpochSummary:
        """Sums over no epochs."""
        w = len(STRENGTHS)
        return EpochSummary(
            hessian=np.zeros((w, 6, 6)),
            gradient=np.zeros((w, 6)),
            scatter=np.zeros((w, 6, 6)),
            frames=np.zeros(w),
            evidence=np.zeros(w),
            walk=0,
            halves_hessian=np.zeros((2, 6, 6)),
            halves_gradient=np.zeros((2, 6)),
            next_half=0,
        )

    def shift_reference(self, step: Array) -> EpochSummary:
        """The sums about a reference that is moved by a tangent step."""
        return replace(
            self,
            gradient=self.gradient + self.hessian @ step,
            halves_gradient=self.halves_gradient + self.halves_hessian @ step,
            ungated_gradient=self.ungated_gradient + self.ungated_hessian @ step,
        )

    def add(self, hessian: Array, gradient: Array, scatter: Array, frames: int) -> EpochSummary:
        """The sums with an epoch's added, taken at the same reference."""
        halves_hessian, halves_gradient = self.halves_hessian.copy(), self.halves_gradient.copy()
        halves_hessian[self.next_half] += hessian
        halves_gradient[self.next_half] += gradient
        return replace(
            self,
            hessian=self.hessian + hessian,
            gradient=self.gradient + gradient,
            scatter=self.scatter + scatter,
            frames=self.frames + frames,
            halves_hessian=halves_hessian,
            halves_gradient=halves_gradient,
            next_half=1 - self.next_half,
        )

    def add_ungated(self, hessian: Array, gradient: Array) -> EpochSummary:
        """The sums with those over all matches of an epoch added."""
        return replace(
            self,
            ungated_hessian=self.ungated_hessian + hessian,
            ungated_gradient=self.ungated_gradient + gradient,
        )

    def propagate(self, variance: Array, inflation: float) -> tuple[EpochSummary, Array]:
        """The sums after the random walk of an epoch, and the gain.

        Args:
            variance: (6,) of the configured walk over the epoch.
            inflation: k of the module's description.

        Returns:
            The summary; (6, 6) G of the selected walk.
        """
        gains = np.stack([
            gain_of_walk(H, strength**2 * variance / inflation)
            for H, strength in zip(self.hessian, STRENGTHS, strict=True)
        ])  # fmt: skip
        hessian = gains @ self.hessian
        hessian = (hessian + hessian.transpose(0, 2, 1)) / 2
        walked = STRENGTHS[:, None, None] ** 2 * np.diag(variance)
        kept = np.trace(gains, axis1=1, axis2=2) / 6
        summary = replace(
            self,
            hessian=hessian,
            gradient=np.einsum("wij,wj->wi", gains, self.gradient),
            scatter=gains @ self.scatter @ gains.transpose(0, 2, 1) + hessian @ walked @ hessian,
            frames=self.frames * kept,
            halves_hessian=self.halves_hessian * kept[self.walk],
            halves_gradient=self.halves_gradient * kept[self.walk],
            ungated_hessian=self.ungated_hessian * kept[self.walk],
            ungated_gradient=self.ungated_gradient * kept[self.walk],
        )
        return summary, gains[self.walk]

    def update_evidence(self, hessian: Array, gradient: Array, noise: Array) -> EpochSummary:
        """The summary with the walks' evidence updated by how well each predicts an epoch.

        Args:
            hessian: (6, 6) the epoch's.
            gradient: (6,) the epoch's, at the reference.
            noise: (6, 6) covariance of such a gradient at the true extrinsic.
        """
        if not (self.frames >= _LEAST_FRAMES).all():
            return self
        steps = np.linalg.solve(self.hessian, -self.gradient[..., None])[..., 0]
        score = gradient + steps @ hessian
        spread = np.linalg.solve(self.hessian, hessian[None])
        covariance = noise + spread.transpose(0, 2, 1) @ self.scatter @ spread
        whitened = np.linalg.solve(covariance, score[..., None])[..., 0]
        distance = (score * whitened).sum(axis=1)
        logarithm = np.linalg.slogdet(covariance)[1]
        logarithm = logarithm - logarithm.min()
        gain = -0.5 * (np.minimum(distance, _DISTANCE_CAP) + logarithm)
        return replace(self, evidence=_EVIDENCE_KEPT * self.evidence + gain)

    def select_walk(self) -> EpochSummary:
        """The summary with the walk selected by the evidence.

        During a drift the static sums become outdated. Whenever the evidence is against them, they
        restart from those of the walk, and must gain evidence from there.
        """
        best = self.best_walk
        if self.walk == 0:
            if self.evidence[best] - self.evidence[0] <= _SELECT_WALK:
                return self
            return replace(
                self, walk=best, evidence=np.zeros_like(self.evidence)
            )._restart_static_from(best)
        if self.evidence[0] - self.evidence[self.walk] > _SELECT_STATIC:
            return replace(self, walk=0, evidence=np.zeros_like(self.evidence))
        walk = self.walk
        if self.evidence[best] - self.evidence[walk] > _PREFER_WALK:
            walk = best
        summary = replace(self, walk=walk)
        if self.evidence[walk] - self.evidence[0] > _PREFER_WALK:
            summary = summary._restart_static_from(walk)
        return summary

    @property
    def selected(self) -> tuple[Array, Array, Array, float]:
        """The sums of the selected walk: Hessian, gradient, scatter, frames."""
        w = self.walk
        return self.hessian[w], self.gradient[w], self.scatter[w], float(self.frames[w])

    @property
    def best_walk(self) -> int:
        """The walk with the most evidence, the static one left out."""
        return 1 + int(np.argmax(self.evidence[1:]))

    def with_walk(self, walk: int) -> EpochSummary:
        """The summary with a walk selected for other reasons than the evidence."""
        return replace(self, walk=walk, evidence=np.zeros_like(self.evidence))._restart_static_from(
            walk
        )

    def _restart_static_from(self, walk: int) -> EpochSummary:
        """The summary with the static sums restarted from those of a walk."""
        columns = {}
        for name in ("hessian", "gradient", "scatter", "frames", "evidence"):
            column = getattr(self, name).copy()
            column[0] = column[walk]
            columns[name] = column
        return replace(self, **columns)


def gain_of_walk(hessian: Array, variance: Array) -> Array:
    """(6, 6) G with ``(H^-1 + diag(variance))^-1 = G H``; H may be singular."""
    if not variance.any():
        return np.eye(6)
    return np.asarray(np.linalg.inv(np.eye(6) + hessian * variance), dtype=np.float64)


def step_between(one: gtsam.Pose3, two: gtsam.Pose3) -> Array:
    """(6,) tangent step from one T_lidar_camera to another."""
    return np.asarray(one.localCoordinates(two))
