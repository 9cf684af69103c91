"""Correspondences as a matcher could find them: a rig, a scene, and its errors, from one seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera, Rig
from calibgraph.solver.pnp import normalized

Array = NDArray[np.float64]
Rng = np.random.Generator

_MAX_TRIES = 1000
_HALF = 0.5
_STUCK_SIZE = 1.3  # as what size of errors a confidence shows that a frame is stuck
_MOST_SIZE = 1.6  # of what a confidence shows

_LIDAR_HEIGHT_M, _FAR_M = 1.73, 80.0
_WALLS_M = (7.0, 12.0)
_BEAMS_RAD = (math.radians(-25.0), math.radians(15.0))
_CLUTTER = 0.4  # share of the rays that end before the walls and the road


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
    """How a simulated matcher errs.

    Attributes:
        noise_px: standard deviation per axis, independent per correspondence.
        noise_spread: standard deviation of the logarithm of each correspondence's own noise.
        frame_noise_px: standard deviation per axis of an offset shared by a camera's frame.
        field_px: root mean square per axis of an error that is smooth over the image (a
            polynomial of second order), of a camera's frame.
        frame_spread: standard deviation of the logarithm of a frame's own size of all that.
        bias_px: as ``field_px``, of an error that all frames of a camera share.
        bias_pose: all matches of a camera are those of a pose displaced by a draw of this.
        stuck_share: share of a camera's frames in which the matcher stops short: their matches
            are those of a displaced pose.
        stuck_pose: of the displacement, a draw per camera.
        stuck_scatter: how much frames differ in it: each takes the camera's draw times a uniform
            draw from 0 to 2, and adds a draw of its own of this size.
        outlier_share: share of correspondences whose pixel is anywhere in the image.
        failed_share: share of a camera's frames in which all of them are.
        informative_confidence: outliers and correspondences with much noise, of frames with much
            of it or that are stuck, get lower confidences; else all are alike.
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


def simulate_correspondences(
    rig: Rig,
    *,
    frames: int = 10,
    matches: int = 500,
    errors: MatcherErrors | Mapping[str, MatcherErrors] | None = None,
    depth_m: tuple[float, float] | None = (3.0, 50.0),
    seed: int = 0,
) -> Correspondences:
    """Draw correspondences that a matcher could find, with the rig's poses as the truth.

    Args:
        rig: its poses are the truth.
        frames: frames, seen by every camera.
        matches: correspondences per camera and frame.
        errors: the matcher's errors, of all cameras or per camera.
        depth_m: range of depths along the camera's axis, drawn uniformly in the logarithm; None for
            a street: a road 1.73 m below the LiDAR, walls to its left and right, things in front
            of them, and what beams from -25 to 15 degrees see of that up to 80 m.
        seed: of every draw.
    """
    rng = np.random.default_rng(seed)
    matchers = _matchers(rig, errors, seed)
    tables = [
        matcher.frame(rng, name, frame, count=matches, depth_m=depth_m)
        for frame in range(frames)
        for name, matcher in matchers.items()
    ]
    return concatenate(tables)


def _matchers(
    rig: Rig, errors: MatcherErrors | Mapping[str, MatcherErrors] | None, seed: int
) -> dict[str, _Matcher]:
    """A matcher per camera. From 1 on: NumPy's generators of [seed, 0] and of seed are the same."""
    return {
        name: _Matcher(camera, _errors_of(errors, name), [seed, number])
        for number, (name, camera) in enumerate(rig.cameras.items(), start=1)
    }


def _errors_of(
    errors: MatcherErrors | Mapping[str, MatcherErrors] | None, name: str
) -> MatcherErrors:
    if errors is None:
        return MatcherErrors()
    return errors if isinstance(errors, MatcherErrors) else errors[name]


def simulate_drive(
    rig_at: Callable[[int], Rig],
    *,
    frames: int,
    matches: int = 500,
    errors: MatcherErrors | None = None,
    depth_m: tuple[float, float] = (3.0, 50.0),
    failed_share: float = 0.0,
    blind: Mapping[str, range] | None = None,
    seed: int = 0,
) -> Iterator[Correspondences]:
    """Draw the frames of a drive, one table each, in which extrinsics may change.

    Args:
        rig_at: the true rig at a frame's number.
        frames: how many.
        matches: correspondences per camera and frame.
        errors: the matcher's errors.
        depth_m: range of depths along the camera's axis.
        failed_share: share of a camera's frames whose matches are wrong: all random, or all of a
            pose that is wrong by 1 to 5 deg and 10 to 50 cm, half of them each.
        blind: per camera, the frames in which it sees nothing.
        seed: of every draw.
    """
    errors = errors or MatcherErrors()
    rng = np.random.default_rng(seed)
    nonsense = replace(errors, outlier_share=1.0, informative_confidence=False)
    matchers = _matchers(rig_at(0), errors, seed)
    for frame in range(frames):
        tables = []
        for name, camera in rig_at(frame).cameras.items():
            if frame in (blind or {}).get(name, ()):
                continue
            failed, at_random = rng.random() < failed_share, rng.random() < _HALF
            seen = _elsewhere(rng, camera) if failed and not at_random else camera
            made = nonsense if failed and at_random else errors
            matcher = matchers[name].seeing(seen, made)
            tables.append(matcher.frame(rng, name, frame, count=matches, depth_m=depth_m))
        yield concatenate(tables)


def _elsewhere(rng: Rng, camera: Camera) -> Camera:
    """The camera at a wrong pose."""
    axis, direction = rng.standard_normal((2, 3))
    step = np.eye(4)
    angle = np.radians(rng.uniform(1, 5))
    step[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    step[:3, 3] = rng.uniform(0.1, 0.5) * direction / np.linalg.norm(direction)
    return camera.moved_to(step @ camera.T_camera_lidar)


class _Matcher:
    """A simulated matcher of one camera, with the errors that all its frames share.

    What :class:`MatcherErrors` adds to noise and outliers is drawn from a generator of its own.
    """

    def __init__(self, camera: Camera, errors: MatcherErrors, seed: Sequence[int]) -> None:
        self.camera, self.errors = camera, errors
        self.rng = np.random.default_rng(seed)
        self.bias_pose = errors.bias_pose.draw(self.rng)
        self.stuck_pose = errors.stuck_pose.draw(self.rng)
        self.bias = errors.bias_px * _polynomial(self.rng)

    def seeing(self, camera: Camera, errors: MatcherErrors) -> _Matcher:
        """This matcher, its shared errors and its generator, with the camera as it is now."""
        now = copy(self)
        now.camera, now.errors = camera, errors
        return now

    def frame(
        self,
        rng: Rng,
        name: str,
        frame: int,
        *,
        count: int,
        depth_m: tuple[float, float] | None,
    ) -> Correspondences:
        """The table of one frame."""
        errors, own = self.errors, self.rng
        points_camera = _visible_points(rng, self.camera, count, depth_m)
        stuck, failed = own.random(2) < (errors.stuck_share, errors.failed_share)
        size = math.exp(errors.frame_spread * own.standard_normal())
        sizes = size * np.exp(errors.noise_spread * own.standard_normal(count))
        pixels, lost = self._seen(points_camera, stuck=bool(stuck))
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
            metadata={"matcher": "simulated", "errors": asdict(errors)},
        )

    def _seen(self, points_camera: Array, *, stuck: bool) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) pixels by the pose that the matcher believes in; (n,) which are off the image."""
        twist = self.bias_pose.copy()
        if stuck:
            spread, own = self.errors.stuck_pose, self.rng
            twist += own.uniform(0, 2) * self.stuck_pose
            twist += self.errors.stuck_scatter * spread.draw(own)
        turned = points_camera @ Rotation.from_rotvec(twist[:3]).as_matrix().T
        pixels, valid = self.camera.lens.project(turned + twist[3:])
        return pixels, ~(valid & self.camera.in_image(pixels))

    def _field(self, pixels: Array, size: float) -> Array:
        """(n, 2) errors that are smooth over the image."""
        errors = self.errors
        if not (errors.field_px or errors.bias_px):
            return np.zeros_like(pixels)
        u, v = (2 * (pixels + 0.5) / [self.camera.width_px, self.camera.height_px] - 1).T
        terms = np.column_stack([np.ones_like(u), u, v, u * v, u**2 - 1 / 3, v**2 - 1 / 3])
        return np.asarray(terms @ (self.bias + size * errors.field_px * _polynomial(self.rng)))

    def _confidence(self, rng: Rng, outlier: NDArray[np.bool_], sizes: Array) -> Array:
        """(n,) confidences: of outliers, and of inliers by their noise."""
        count = len(outlier)
        low = outlier if self.errors.informative_confidence else np.zeros(count, np.bool_)
        confidence = np.where(low, rng.uniform(0.1, 0.6, count), rng.uniform(0.4, 1.0, count))
        if self.errors.informative_confidence:
            confidence[~low] = 1 - (1 - confidence[~low]) * np.minimum(sizes[~low], _MOST_SIZE)
        return np.asarray(confidence)


def _polynomial(rng: Rng) -> Array:
    """(6, 2) coefficients of a polynomial of second order on the square [-1, 1]^2, of unit rms."""
    terms_squared = np.array([1.0, 1 / 3, 1 / 3, 1 / 9, 4 / 45, 4 / 45])  # mean over the square
    drawn = rng.standard_normal((6, 2))
    return np.asarray(drawn / np.sqrt(terms_squared.sum()))


def _visible_points(
    rng: Rng, camera: Camera, count: int, depth_m: tuple[float, float] | None
) -> Array:
    """(count, 3) points in the camera frame that project into the image, by rejection."""
    kept = np.empty((0, 3))
    for _ in range(_MAX_TRIES):
        if depth_m is None:
            points = _on_street(rng, camera, 2 * count)
        else:
            points = _scattered(rng, camera, 2 * count, depth_m)
        pixels, valid = camera.lens.project(points)
        kept = np.vstack([kept, points[valid & camera.in_image(pixels)]])
        if len(kept) >= count:
            return kept[:count]
    where = "of a street" if depth_m is None else f"between {depth_m} m"
    raise ValueError(f"no {count} points {where} project into the image")


def _scattered(rng: Rng, camera: Camera, count: int, depth_m: tuple[float, float]) -> Array:
    """(count, 3) points in the camera frame, over about the image."""
    low, high = np.log(depth_m)
    spread = 1.2 * np.array([camera.width_px, camera.height_px]) / 2
    focal = np.array([camera.intrinsics_px.fx, camera.intrinsics_px.fy])
    angles = rng.uniform(-1, 1, (count, 2)) * np.minimum(spread / focal, 1.4)
    distance = np.exp(rng.uniform(low, high, count))
    rays = np.column_stack([np.tan(angles), np.ones(count)])
    return np.asarray(rays * (distance / np.linalg.norm(rays, axis=1))[:, None])


def _on_street(rng: Rng, camera: Camera, count: int) -> Array:
    """(at most count, 3) points in the camera frame that a LiDAR sees of a street."""
    size = np.array([camera.width_px, camera.height_px])
    plane = normalized(camera, rng.random((count, 2)) * size - 0.5)
    T_lidar_camera = invert(camera.T_camera_lidar)
    rays = np.column_stack([plane, np.ones(count)]) @ T_lidar_camera[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1)[:, None]
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
