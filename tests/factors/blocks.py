"""A small world seen by every lens, for the tests of blocks."""

from __future__ import annotations

import gtsam
import numpy as np

from factors import Lens, ProjectionBlock
from tests.conftest import KANNALA, RADTAN5, RADTAN8
from tests.draws.cameras import FORWARD

K = {"fx": 718.0, "fy": 710.0, "cx": 607.0, "cy": 185.0}


LENSES = {
    "pinhole": Lens.of("pinhole", **K),
    "radtan": Lens.of("pinhole", **K, distortion=RADTAN5),
    "rational": Lens.of("pinhole", **K, distortion=RADTAN8),
    "fisheye": Lens.of("fisheye", **K, distortion=KANNALA),
    "omnidirectional": Lens.of("omnidirectional", **K, distortion=(1.2, *RADTAN5[:4])),
}


KEY = 7


TRUTH = gtsam.Pose3(gtsam.Rot3(FORWARD.T), np.array([0.3, 0.1, -0.1]))  # T_lidar_camera


def world(lens: Lens, count: int, *, outliers: float = 0.2) -> ProjectionBlock:
    """Correspondences with 1 px noise, outliers, and anisotropic whitening, some of rank one."""
    rng = np.random.default_rng(0)
    rays = np.column_stack([rng.uniform(-0.8, 0.8, count), rng.uniform(-0.2, 0.2, count)])
    points = np.column_stack([rays, np.ones(count)]) * rng.uniform(3, 40, count)[:, None]
    pixels = lens.project(points)[0] + rng.standard_normal((count, 2))
    wrong = rng.random(count) < outliers
    pixels[wrong] += rng.uniform(-300, 300, (np.count_nonzero(wrong), 2))
    roots = np.column_stack(
        [rng.uniform(0.2, 2, count), rng.uniform(-1, 1, count), rng.uniform(0.2, 2, count)]
    )
    roots[::5, 2] = 0.0
    in_lidar = points @ TRUTH.rotation().matrix().T + TRUTH.translation()
    return ProjectionBlock(lens, in_lidar, pixels, roots, scale=3.0)


def at(pose: gtsam.Pose3) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(KEY, pose)
    return values


def poses(seed: int = 5) -> list[gtsam.Pose3]:
    """At the truth, near it, a little off, and far off (some points then lie behind)."""
    rng = np.random.default_rng(seed)
    sizes = [0.0, 1e-7, 0.02, 0.5, 2.0]
    return [TRUTH.retract(size * rng.standard_normal(6)) for size in sizes]
