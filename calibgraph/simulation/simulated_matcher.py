"""A simulated matcher: correspondences of one camera and frame, with a matcher's errors."""

import math
from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera
from calibgraph.simulation.matcher_errors import MatcherErrors
from calibgraph.simulation.visible_points import draw_visible_points

Rng = np.random.Generator

_STUCK_SIZE = 1.3  # the size of errors that the confidences of a stuck frame express
_MAX_SIZE = 1.6  # largest size that a confidence expresses


class SimulatedMatcher:
    """A simulated matcher of one camera, with the errors that all its frames share.

    Its own generator draws all errors but noise and outliers, so that these do not depend on which
    of the others are simulated.

    Attributes:
        camera: its lens and true T_camera_lidar.
        errors: sizes of the errors.
        rng: its own generator.
        bias_twist: (6,) displacement of all frames: rotation vector [rad], translation [m].
        stuck_twist: (6,) displacement of stuck frames.
        bias_field: (6, 2) polynomial coefficients [px] of the error that all frames share.
    """

    def __init__(self, camera: Camera, errors: MatcherErrors, seed: Sequence[int]) -> None:
        self.camera, self.errors = camera, errors
        self.rng = np.random.default_rng(seed)
        self.bias_twist = errors.bias_pose.draw(self.rng)
        self.stuck_twist = errors.stuck_pose.draw(self.rng)
        self.bias_field = errors.bias_px * _draw_polynomial(self.rng)

    def match(
        self,
        rng: Rng,
        name: str,
        frame: int,
        *,
        count: int,
        depth_m: tuple[float, float] | None,
    ) -> Correspondences:
        """Draw the table of one frame.

        Args:
            rng: draws points, noise and outliers.
            name: of the camera.
            frame: number of the frame.
            count: of correspondences.
            depth_m: range of depths, or None for a street.
        """
        errors, own = self.errors, self.rng
        points_camera = draw_visible_points(rng, self.camera, count, depth_m)
        stuck, failed = own.random(2) < (errors.stuck_share, errors.failed_share)
        size = math.exp(errors.frame_spread * own.standard_normal())
        sizes = size * np.exp(errors.noise_spread * own.standard_normal(count))
        pixels, lost = self._project(points_camera, stuck=bool(stuck))
        pixels += errors.noise_px * sizes[:, None] * rng.standard_normal(pixels.shape)
        pixels += size * errors.frame_noise_px * rng.standard_normal(2)
        pixels += self._field(pixels, size)
        outlier = (rng.random(count) < errors.outlier_share) | lost | failed
        image = np.array([self.camera.width_px, self.camera.height_px])
        pixels[outlier] = rng.random((np.count_nonzero(outlier), 2)) * image - 0.5
        T = self.camera.T_camera_lidar
        return Correspondences.from_arrays(
            camera=name,
            frame=frame,
            pixels_px=pixels,
            points_lidar_m=(points_camera - T[:3, 3]) @ T[:3, :3],
            confidence=self._confidence(rng, outlier, sizes * (_STUCK_SIZE if stuck else 1.0)),
            metadata={"matcher": "simulated", "errors": asdict(errors), **self._common_error},
        )

    @property
    def _common_error(self) -> dict[str, float]:
        """The statement that frames share no error, if true; otherwise nothing is stated."""
        if self.errors.bias_px or self.bias_twist.any():
            return {}
        return {"systematic_rotation_rad": 0.0, "systematic_translation_m": 0.0}

    def _project(self, points_camera: Array, *, stuck: bool) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) pixels at the displaced pose; (n,) which are off the image."""
        twist = self.bias_twist.copy()
        if stuck:
            spread, own = self.errors.stuck_pose, self.rng
            twist += own.uniform(0, 2) * self.stuck_twist
            twist += self.errors.stuck_scatter * spread.draw(own)
        turned = points_camera @ Rotation.from_rotvec(twist[:3]).as_matrix().T
        pixels, valid = self.camera.lens.project(turned + twist[3:])
        return pixels, ~(valid & self.camera.in_image(pixels))

    def _field(self, pixels: Array, size: float) -> Array:
        """(n, 2) errors [px] that are smooth over the image."""
        errors = self.errors
        if not (errors.field_px or errors.bias_px):
            return np.zeros_like(pixels)
        u, v = (2 * (pixels + 0.5) / [self.camera.width_px, self.camera.height_px] - 1).T
        terms = np.column_stack([np.ones_like(u), u, v, u * v, u**2 - 1 / 3, v**2 - 1 / 3])
        return np.asarray(
            terms @ (self.bias_field + size * errors.field_px * _draw_polynomial(self.rng))
        )

    def _confidence(self, rng: Rng, outlier: NDArray[np.bool_], sizes: Array) -> Array:
        """(n,) confidences: lower for outliers, and for inliers by the size of their noise."""
        count = len(outlier)
        low = outlier if self.errors.informative_confidence else np.zeros(count, np.bool_)
        confidence = np.where(low, rng.uniform(0.1, 0.6, count), rng.uniform(0.4, 1.0, count))
        if self.errors.informative_confidence:
            confidence[~low] = 1 - (1 - confidence[~low]) * np.minimum(sizes[~low], _MAX_SIZE)
        return np.asarray(confidence)


def _draw_polynomial(rng: Rng) -> Array:
    """(6, 2) coefficients of a second-order polynomial on [-1, 1]^2 of unit root mean square."""
    terms_squared = np.array([1.0, 1 / 3, 1 / 3, 1 / 9, 4 / 45, 4 / 45])  # mean over the square
    drawn = rng.standard_normal((6, 2))
    return np.asarray(drawn / np.sqrt(terms_squared.sum()))
