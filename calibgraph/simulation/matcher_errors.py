"""The errors of a simulated matcher."""

from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array

Rng = np.random.Generator


@dataclass(frozen=True)
class PoseSpread:
    """Standard deviations of a displacement, along and about the camera's x, y and z axes."""

    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    translation_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def draw(self, rng: Rng) -> Array:
        """(6,) rotation vector [rad] and translation [m] of a displacement."""
        sigmas = np.concatenate([np.radians(self.rotation_deg), self.translation_m])
        return np.asarray(sigmas * rng.standard_normal(6))


@dataclass(frozen=True, kw_only=True)
class MatcherErrors:
    """The errors of a simulated matcher.

    Attributes:
        noise_px: standard deviation per axis, independent per correspondence.
        noise_spread: standard deviation of the logarithm of a correspondence's noise factor.
        frame_noise_px: standard deviation per axis of an offset per camera and frame.
        field_px: root mean square per axis of an error per camera and frame that is smooth over the
            image (a polynomial of second order).
        frame_spread: standard deviation of the logarithm of a frame's factor on all of the above.
        bias_px: as ``field_px``, of an error that all frames of a camera share.
        bias_pose: displacement of the pose to which all matches of a camera belong.
        stuck_share: share of a camera's frames whose matches belong to a displaced pose, as of a
            matcher that stops before the truth.
        stuck_pose: that displacement, drawn once per camera.
        stuck_scatter: its scatter between frames: each takes the camera's draw times a uniform
            number from 0 to 2, plus a draw of its own times this.
        outlier_share: share of correspondences with a random pixel.
        failed_share: share of a camera's frames in which all pixels are random.
        informative_confidence: whether confidences are lower for outliers, and for correspondences
            with large noise, in frames with large noise, and in stuck frames.
    """

    noise_px: float = 1.0
    noise_spread: float = 0.0
    frame_noise_px: float = 0.0
    field_px: float = 0.0
    frame_spread: float = 0.0
    bias_px: float = 0.0
    bias_pose: PoseSpread = PoseSpread()
    stuck_share: float = 0.0
    stuck_pose: PoseSpread = PoseSpread()
    stuck_scatter: float = 0.5
    outlier_share: float = 0.0
    failed_share: float = 0.0
    informative_confidence: bool = True
