"""Against a tree of all rays, which SciPy searches: everywhere on the sphere, and on scan lines."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from calibgraph.arrays import Array
from calibgraph.matching.structure.directions import sphere_angles, thin
from calibgraph.matching.structure.nearest_rays import NearestRays

MOST = 9


def on_the_sphere(rng: np.random.Generator) -> Array:
    return rng.standard_normal((4000, 3)) * rng.uniform(2, 30, (4000, 1))


def on_scan_lines(rng: np.random.Generator) -> Array:
    """Of a LiDAR with 16 lines, all around."""
    azimuth, elevation = rng.uniform(-np.pi, np.pi, 4000), rng.integers(-8, 8, 4000) * 0.035
    level = np.cos(elevation)
    rays = [level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)]
    return np.column_stack(rays) * rng.uniform(2, 30, (4000, 1))


@pytest.mark.parametrize("draw", [on_the_sphere, on_scan_lines])
@pytest.mark.parametrize("reach", [0.05, 2.0])
def test_finds_the_rays_that_a_tree_finds(draw: object, reach: float) -> None:
    rays = draw(np.random.default_rng(0))  # type: ignore[operator]
    angles = sphere_angles(rays)
    kept = thin(angles, 0.02)
    nearest = NearestRays(rays, kept.astype(np.int32), angles[kept], 0.02)
    members, counts = nearest.of(np.arange(len(kept), dtype=np.int32), MOST, reach)

    directions = rays[kept] / np.linalg.norm(rays[kept], axis=1, keepdims=True)
    _, found = cKDTree(directions).query(directions, MOST, distance_upper_bound=reach)
    inside = found < len(kept)
    expected = np.where(inside, found, np.arange(len(kept))[:, None])
    np.testing.assert_array_equal(counts, inside.sum(axis=1))
    np.testing.assert_array_equal(members, kept[expected])
    assert 0.2 < inside.mean() <= 1
