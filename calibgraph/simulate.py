"""A small simulator of correspondences: a rig, a scene, and a matcher's errors, from one seed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.correspondences import Correspondences, concatenate
from calibgraph.rig import Camera, Rig

Array = NDArray[np.float64]

_MAX_TRIES = 1000
_HALF = 0.5


@dataclass(frozen=True, kw_only=True)
class MatcherErrors:
    """How a simulated matcher errs.

    Attributes:
        noise_px: standard deviation per axis, independent per correspondence.
        frame_noise_px: the same, of an offset shared by a camera's frame.
        outlier_share: share of correspondences whose pixel is anywhere in the image.
        informative_confidence: outliers get lower confidences than inliers, else all are alike.
    """

    noise_px: float = 1.0
    frame_noise_px: float = 0.0
    outlier_share: float = 0.0
    informative_confidence: bool = True


def simulate_correspondences(
    rig: Rig,
    *,
    frames: int = 10,
    matches: int = 500,
    errors: MatcherErrors | None = None,
    depth_m: tuple[float, float] = (3.0, 50.0),
    seed: int = 0,
) -> Correspondences:
    """Draw correspondences that a matcher could find, with the rig's poses as the truth.

    Args:
        rig: its poses are the truth.
        frames: frames, seen by every camera.
        matches: correspondences per camera and frame.
        errors: the matcher's errors.
        depth_m: range of depths along the camera's axis, drawn uniformly in the logarithm.
        seed: of every draw.
    """
    errors = errors or MatcherErrors()
    rng = np.random.default_rng(seed)
    tables = [
        _frame(rng, name, camera, frame, matches, errors, depth_m)
        for frame in range(frames)
        for name, camera in rig.cameras.items()
    ]
    return concatenate(tables)


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
    for frame in range(frames):
        tables = []
        for name, camera in rig_at(frame).cameras.items():
            if frame in (blind or {}).get(name, ()):
                continue
            failed, at_random = rng.random() < failed_share, rng.random() < _HALF
            seen = _elsewhere(rng, camera) if failed and not at_random else camera
            made = nonsense if failed and at_random else errors
            tables.append(_frame(rng, name, seen, frame, matches, made, depth_m))
        yield concatenate(tables)


def _elsewhere(rng: np.random.Generator, camera: Camera) -> Camera:
    """The camera at a wrong pose."""
    axis, direction = rng.standard_normal((2, 3))
    step = np.eye(4)
    angle = np.radians(rng.uniform(1, 5))
    step[:3, :3] = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
    step[:3, 3] = rng.uniform(0.1, 0.5) * direction / np.linalg.norm(direction)
    return camera.moved_to(step @ camera.T_camera_lidar)


def _frame(  # noqa: PLR0913 - private, one call
    rng: np.random.Generator,
    name: str,
    camera: Camera,
    frame: int,
    matches: int,
    errors: MatcherErrors,
    depth_m: tuple[float, float],
) -> Correspondences:
    points_camera = _visible_points(rng, camera, matches, depth_m)
    pixels, _ = camera.lens.project(points_camera)
    pixels += errors.noise_px * rng.standard_normal(pixels.shape)
    pixels += errors.frame_noise_px * rng.standard_normal(2)
    outlier = rng.random(matches) < errors.outlier_share
    size = np.array([camera.width_px, camera.height_px])
    pixels[outlier] = rng.random((np.count_nonzero(outlier), 2)) * size - 0.5
    low = outlier if errors.informative_confidence else np.zeros(matches, np.bool_)
    confidence = np.where(low, rng.uniform(0.1, 0.6, matches), rng.uniform(0.4, 1.0, matches))
    T = camera.T_camera_lidar
    return Correspondences.from_arrays(
        camera=name,
        frame=frame,
        pixels_px=pixels,
        points_lidar_m=(points_camera - T[:3, 3]) @ T[:3, :3],
        confidence=confidence,
        metadata={"matcher": "simulated", **vars(errors)},
    )


def _visible_points(
    rng: np.random.Generator, camera: Camera, count: int, depth_m: tuple[float, float]
) -> Array:
    """(count, 3) points in the camera frame that project into the image, by rejection."""
    low, high = np.log(depth_m)
    kept = np.empty((0, 3))
    spread = 1.2 * np.array([camera.width_px, camera.height_px]) / 2
    focal = np.array([camera.intrinsics_px.fx, camera.intrinsics_px.fy])
    for _ in range(_MAX_TRIES):
        angles = rng.uniform(-1, 1, (2 * count, 2)) * np.minimum(spread / focal, 1.4)
        distance = np.exp(rng.uniform(low, high, 2 * count))
        rays = np.column_stack([np.tan(angles), np.ones(2 * count)])
        points = rays * (distance / np.linalg.norm(rays, axis=1))[:, None]
        pixels, valid = camera.lens.project(points)
        kept = np.vstack([kept, points[valid & camera.in_image(pixels)]])
        if len(kept) >= count:
            return kept[:count]
    raise ValueError(f"no {count} points between {depth_m} m project into the image")
