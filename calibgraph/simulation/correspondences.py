"""Simulated correspondences: a matcher's table, with its errors."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera, Rig
from factors import unproject

Rng = np.random.Generator

_STUCK_SIZE = 1.3  # the size of errors that the confidences of a stuck frame express
_MAX_SIZE = 1.6  # largest size that a confidence expresses
_MAX_TRIES = 1000


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
        self, rng: Rng, name: str, frame: int, *, count: int, depth_m: tuple[float, float] | None
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


_LIDAR_HEIGHT_M, _FAR_M = 1.73, 80.0
_WALLS_M = (7.0, 12.0)
_BEAMS_RAD = (math.radians(-25.0), math.radians(15.0))
_CLUTTER = 0.4  # share of the rays that end before the walls and the road


def draw_visible_points(
    rng: Rng, camera: Camera, count: int, depth_m: tuple[float, float] | None
) -> Array:
    """Draw points that project into the image, by rejection.

    Args:
        rng: of all draws.
        camera: its lens and T_camera_lidar.
        count: of the points.
        depth_m: range of depths, or None for a street; see :func:`simulate_correspondences`.

    Returns:
        (count, 3) in the camera frame [m].

    Raises:
        ValueError: if the camera sees too few of them.
    """
    kept = np.empty((0, 3))
    for _ in range(_MAX_TRIES):
        if depth_m is None:
            points = _draw_on_street(rng, camera, 2 * count)
        else:
            points = _draw_scattered(rng, camera, 2 * count, depth_m)
        pixels, valid = camera.lens.project(points)
        kept = np.vstack([kept, points[valid & camera.in_image(pixels)]])
        if len(kept) >= count:
            return kept[:count]
    where = "of a street" if depth_m is None else f"between {depth_m} m"
    raise ValueError(f"no {count} points {where} project into the image")


def _draw_scattered(rng: Rng, camera: Camera, count: int, depth_m: tuple[float, float]) -> Array:
    """(count, 3) points in the camera frame, in about the directions of the image."""
    low, high = np.log(depth_m)
    if camera.model == "omnidirectional":
        rays = _draw_rays(rng, camera, count)
        return np.asarray(rays * np.exp(rng.uniform(low, high, (len(rays), 1))))
    spread = 1.2 * np.array([camera.width_px, camera.height_px]) / 2
    focal = np.array([camera.intrinsics_px.fx, camera.intrinsics_px.fy])
    angles = rng.uniform(-1, 1, (count, 2)) * np.minimum(spread / focal, 1.4)
    distance = np.exp(rng.uniform(low, high, count))
    rays = np.column_stack([np.tan(angles), np.ones(count)])
    return np.asarray(rays * (distance / np.linalg.norm(rays, axis=1))[:, None])


def _draw_rays(rng: Rng, camera: Camera, count: int) -> Array:
    """(at most count, 3) unit rays of pixels all over the image."""
    pixels = rng.random((count, 2)) * [camera.width_px, camera.height_px] - 0.5
    rays, valid = unproject(camera.lens, pixels)
    return np.asarray(rays[valid])


def _draw_on_street(rng: Rng, camera: Camera, count: int) -> Array:
    """(at most count, 3) points of a street in the camera frame that a LiDAR sees."""
    rays = _draw_rays(rng, camera, count)
    count = len(rays)
    T_lidar_camera = invert(camera.T_camera_lidar)
    rays = rays @ T_lidar_camera[:3, :3].T
    origin, wall = T_lidar_camera[:3, 3], np.sign(rays[:, 1]) * rng.uniform(*_WALLS_M)
    with np.errstate(divide="ignore"):
        ground = (-_LIDAR_HEIGHT_M - origin[2]) / np.minimum(rays[:, 2], 0)
        aside = (wall - origin[1]) / rays[:, 1]
    distance = np.minimum(np.minimum(np.abs(ground), np.abs(aside)), _FAR_M)
    nearer = rng.random(count) < _CLUTTER
    distance[nearer] *= rng.uniform(0.4, 1.0, np.count_nonzero(nearer))
    points = origin + distance[:, None] * rays
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    seen = (elevation > _BEAMS_RAD[0]) & (elevation < _BEAMS_RAD[1])
    return np.asarray((points[seen] - origin) @ T_lidar_camera[:3, :3])


def simulate_correspondences(
    rig: Rig,
    *,
    frames: int = 10,
    matches: int = 500,
    errors: MatcherErrors | Mapping[str, MatcherErrors] | None = None,
    depth_m: tuple[float, float] | None = (3.0, 50.0),
    seed: int = 0,
) -> Correspondences:
    """Draw correspondences as a matcher might find them.

    Args:
        rig: its extrinsics are the truth.
        frames: frames, seen by every camera.
        matches: correspondences per camera and frame.
        errors: the matcher's errors, of all cameras or per camera.
        depth_m: range of depths along the camera's axis, drawn uniformly in the logarithm; None for
            a street: a road 1.73 m below the LiDAR, walls to its left and right, objects in front
            of them, within the beams of a LiDAR, -25 to 15 degrees and up to 80 m.
        seed: of all draws.

    Raises:
        ValueError: if a camera sees too few points.
    """
    rng = np.random.default_rng(seed)
    matchers = matchers_of(rig, errors, seed).items()
    return concatenate([
        matcher.match(rng, name, frame, count=matches, depth_m=depth_m)
        for frame in range(frames) for name, matcher in matchers
    ])  # fmt: skip


def matchers_of(
    rig: Rig, errors: MatcherErrors | Mapping[str, MatcherErrors] | None, seed: int
) -> dict[str, SimulatedMatcher]:
    """A matcher per camera, numbered from 1: NumPy's generators of [seed, 0] and seed are equal."""
    each = errors if isinstance(errors, Mapping) else dict.fromkeys(rig.cameras, errors)
    return {
        name: SimulatedMatcher(camera, each[name] or MatcherErrors(), [seed, number])
        for number, (name, camera) in enumerate(rig.cameras.items(), start=1)
    }
