"""Simulated matches of pairs of cameras."""

from __future__ import annotations

import numpy as np

from calibgraph import (
    Rig,
)
from calibgraph.model.camera_matches import CameraMatches

FRAMES = 8


def simulated_pairs(
    rig: Rig, *, count: int = 150, noise_px: float = 0.3, outliers: float = 0.1, seed: int = 0
) -> CameraMatches:
    """Features of the first two cameras on random planes, per frame; some without a plane."""
    rng, parts = np.random.default_rng(seed), []
    a, b = list(rig.cameras.values())[:2]
    for frame in range(FRAMES):
        points = np.exp(rng.uniform(np.log(4), np.log(40), (3 * count, 1))) * np.column_stack(
            [
                np.ones(3 * count),
                rng.uniform(-0.7, 0.7, 3 * count),
                rng.uniform(-0.2, 0.2, 3 * count),
            ]
        )
        normals = (
            rng.normal(0, 0.4, points.shape) + points / np.linalg.norm(points, axis=1)[:, None]
        )
        planes = normals / (normals * points).sum(axis=1, keepdims=True)
        pixels, seen = [], np.ones(len(points), np.bool_)
        for camera in (a, b):
            T = camera.T_camera_lidar
            projected, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
            pixels.append(projected + noise_px * rng.standard_normal(projected.shape))
            seen &= valid & camera.in_image(projected)
        rows = np.flatnonzero(seen)[:count]
        both = np.stack(pixels, axis=1)[rows]
        wrong = rng.random(len(rows)) < outliers
        both[wrong, 1, 0] += rng.uniform(-80, 80, np.count_nonzero(wrong))  # along epipolar lines
        sides = np.repeat(planes[rows, None], 2, axis=1)
        sides[rng.random(len(rows)) < 0.3] = np.nan
        parts.append((np.full(len(rows), frame), both, sides))
    columns = [np.concatenate([part[k] for part in parts]) for k in range(3)]
    index = np.tile(np.array([0, 1], np.int32), (len(columns[0]), 1))
    return CameraMatches(tuple(rig.cameras), index, *columns)
