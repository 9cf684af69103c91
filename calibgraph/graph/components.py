"""The variance components of the error model, and the scan distortion that residuals show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibgraph.arrays import Array

EXACT = 1e-5
"""Standard deviation [rad and m] of what holds exactly; less is lost in rounding."""

_SETTLED = 0.1  # relative change of the ratios: the data leave far more open


@dataclass(frozen=True, eq=False)
class VarianceComponents:
    """Covariances of the latent displacements, positive definite, each in the tangent of its pose.

    Attributes:
        cloud: (6, 6) of the cloud at every place, in the LiDAR frame.
        cloud_at_place: (6, 6) of the cloud at one place, about ``cloud``.
        camera: (6, 6) of all matches of a camera, in its axes.
        pairs: (6, 6) of all pairs of a camera, in its axes.
        at_place: (P, N, 6, 6) of a camera's matches at one place, about ``camera``.
        scatter_at_place: (P, N, 6, 6) the part of ``at_place`` that the scatter of frames shows.
        distortion_jacobian: (N, 6, B) displacement of a camera's matches by one prior standard
            deviation of each scan distortion; B = 0 without any.
        pair_distortion_jacobian: (N, 6, B) displacement of a camera's pairs by the same.
        distortion_information: (B, B) of the residuals about the distortion.
        distortion_vector: (B,) the information times the distortion that these show.
        distortion_size: prior variance of the distortion, over the stated one.
        robust_scale: tuning constant [sigmas] of the loss of a place (Geman and McClure);
            infinite: none.
    """

    cloud: Array
    cloud_at_place: Array
    camera: Array
    pairs: Array
    at_place: Array
    scatter_at_place: Array
    distortion_jacobian: Array
    pair_distortion_jacobian: Array
    distortion_information: Array
    distortion_vector: Array
    distortion_size: float | Array = 1.0
    robust_scale: float = np.inf

    @property
    def distortion_constant(self) -> float:
        """That of the quadratic by the residuals, with which it has no negative value."""
        vector = self.distortion_vector
        return float(vector @ np.linalg.pinv(self.distortion_information) @ vector)


@dataclass(frozen=True)
class VarianceRatios:
    """Variances over their priors.

    Attributes:
        shared: of what all places share: the cloud, its distortion, the cameras' matches and pairs.
        cloud: of the cloud at one place.
        cameras: of a camera's matches at one place.
    """

    shared: float = 1.0
    cloud: float = 1.0
    cameras: float = 1.0

    def scale(self, prior: VarianceComponents) -> VarianceComponents:
        """Components of these ratios."""
        return replace(
            prior,
            cloud=self.shared * prior.cloud,
            camera=self.shared * prior.camera,
            pairs=self.shared * prior.pairs,
            distortion_size=self.shared * prior.distortion_size,
            cloud_at_place=self.cloud * prior.cloud_at_place,
            at_place=self.cameras * prior.at_place,
            scatter_at_place=self.cameras * prior.scatter_at_place,
        )

    def is_near(self, other: VarianceRatios) -> bool:
        """Whether all are the same to some percent."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return all(abs(one - two) <= _SETTLED * abs(two) for one, two in pairs)


def least_cost_of_distortion(parts: VarianceComponents) -> float:
    """Twice the error of both factors of the distortion by itself, at its minimum."""
    vector = parts.distortion_vector
    prior = np.diag(1.0 / np.broadcast_to(parts.distortion_size, len(vector)))
    least = vector @ np.linalg.solve(prior + parts.distortion_information, vector)
    return parts.distortion_constant - float(least)
