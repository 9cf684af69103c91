from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from calibgraph.matching.structure.box_search import BodyMaps, Box, search_box
from calibgraph.matching.structure.correlation_maps import CorrelationMaps
from calibgraph.matching.structure.directions import view_angles
from calibgraph.parallel import core_pool
from tests.conftest import make_camera


def test_displacement_inverts_transforms() -> None:
    box = Box(make_camera((0.3, 0.1, -0.1)).T_camera_lidar, 0.3, 1.5)
    displacements = np.random.default_rng(0).uniform(-0.3, 0.3, (5, 6))
    found = box.displacements(box.transforms(displacements))
    np.testing.assert_allclose(found, displacements, atol=1e-12)
    np.testing.assert_array_equal(box.excess(displacements), np.zeros(5))
    assert box.excess(np.full((1, 6), 0.6)) == pytest.approx(3.0)  # three angles, twice as far


@pytest.mark.slow
def test_the_search_finds_where_the_maps_agree() -> None:
    """Groups whose maps have one peak each: half where the true pose puts them, half anywhere."""
    rng = np.random.default_rng(1)
    points = rng.uniform([5, -15, -2], [40, 15, 4], (600, 3))
    true = make_camera((0.3, 0.1, -0.1)).T_camera_lidar
    step, origin, shape = np.radians(0.6), np.radians([-41.0, -15.0]), (50, 137)
    place = (view_angles(points @ true[:3, :3].T + true[:3, 3]) - origin) / step
    outlier = rng.random(600) < 0.5
    place[outlier] = rng.uniform(0, shape[::-1], (np.count_nonzero(outlier), 2))
    v, u = np.mgrid[: shape[0], : shape[1]]
    squares = (u - place[:, 0, None, None]) ** 2 + (v - place[:, 1, None, None]) ** 2
    maps = np.exp(-0.5 * squares / 2.0**2).astype(np.float32)
    maps -= maps.mean(axis=(1, 2), keepdims=True)
    correlation = CorrelationMaps(maps, points, origin, step)
    body = BodyMaps([correlation], [np.eye(4)])
    guess = Box(true, np.radians(20), 1.5).transforms(rng.uniform(-1, 1, (1, 6)) * 0.3)[0]
    box = Box(guess, np.radians(20), 1.5)
    with core_pool() as cores:
        found = search_box(body, box, cores, seed=0)
    off = Box(true, 1.0, 1.0).displacements(found[0][None])[0]
    assert np.abs(off[:3]).max() < np.radians(0.6)  # a step of the maps
    assert np.abs(off[3:]).max() < 0.15  # a step at 15 m
    with ThreadPoolExecutor(1) as alone:
        again = search_box(body, box, alone, seed=0)
    np.testing.assert_array_equal(again, found)  # whatever the number of threads
