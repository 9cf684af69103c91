"""The variance components of the error model, and the scan distortion that residuals show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from calibgraph.arrays import Array

EXACT = 1e-5
"""Standard deviation [rad and m] of what holds exactly; less is lost in rounding."""


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
        distortion_information: (P, N, B, B) of a camera's residuals at a place about the
            distortion.
        distortion_vector: (P, N, B) the information times the distortion that these show.
        distortion_weight: (P, N) weight of these.
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
    distortion_weight: Array
    distortion_size: float | Array = 1.0
    robust_scale: float = np.inf

    def with_fixed_weights(self, weight: Array) -> VarianceComponents:
        """Quadratic losses of the same curvature as the robust ones.

        Args:
            weight: (P, 1 + N) of the cloud and of each camera at each place.
        """
        clouds = self.cloud_at_place / weight[:, 0, None, None]
        cameras = weight[:, 1:, None, None]
        return replace(
            self,
            cloud_at_place=clouds,
            at_place=self.at_place / cameras,
            scatter_at_place=self.scatter_at_place / cameras,
            robust_scale=np.inf,
        )


def least_cost_of_distortion(parts: VarianceComponents) -> float:
    """Twice the error of both factors of the distortion by itself, at its minimum."""
    information, vector, constant = shown_distortion(parts)
    prior = np.diag(1.0 / np.broadcast_to(parts.distortion_size, len(vector)))
    return constant - float(vector @ np.linalg.solve(prior + information, vector))


def shown_distortion(parts: VarianceComponents) -> tuple[Array, Array, float]:
    """(B, B) information, (B,) vector and constant by the residuals of all places."""
    weight = parts.distortion_weight
    information = np.einsum("pn,pnij->ij", weight, parts.distortion_information)
    vector = np.einsum("pn,pni->i", weight, parts.distortion_vector)
    return information, vector, float(vector @ np.linalg.pinv(information) @ vector)
