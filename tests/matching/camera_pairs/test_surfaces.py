"""Surfaces at features: exact on planes, none where there is no surface or no knowledge of it."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.matching.camera_pairs.surfaces import NEIGHBOURS, planes_at
from calibgraph.model.geometry import inverse_ranges, invert, planes_in_lidar
from tests.conftest import FORWARD

Array = np.ndarray


def directions(azimuth_deg: Array, elevation_deg: Array) -> Array:
    """Unit vectors of a grid of angles; x right, y down, z forward."""
    a, e = (np.radians(each).ravel() for each in np.meshgrid(azimuth_deg, elevation_deg))
    return np.column_stack([np.sin(a) * np.cos(e), -np.sin(e), np.cos(a) * np.cos(e)])


SCAN = directions(np.arange(-40, 40, 0.2), np.arange(-12, 3, 0.4))


def on_plane(rays: Array, g: Array) -> Array:
    """Points of g . X = 1 on rays that meet it ahead."""
    inverse = rays @ g
    return rays[inverse > 0.01] / inverse[inverse > 0.01, None]


@pytest.mark.parametrize("g", [[0, 0.6, 0], [0, 0, 0.05], [0.15, 0.02, 0.03]], ids=str)
def test_planes_are_found_exactly(g: list[float]) -> None:
    """The ground 1.7 m below, a wall 20 m ahead, a house along the street."""
    cloud = on_plane(SCAN, np.array(g))
    rays = directions(np.arange(-30, 30, 3.3), np.arange(-10, -2, 1.7))
    seen = rays @ g > 0.03
    found = planes_at(rays[seen], cloud)
    assert np.isfinite(found).all()
    assert np.abs(found - g).max() < 1e-12


def test_there_is_none_at_silhouettes_and_one_beside_them() -> None:
    """A car's side at 8 m hides a wall at 20 m, to the left of 0 deg."""
    near = SCAN[:, 0] < 0
    cloud = np.vstack([on_plane(SCAN[near], [0, 0, 1 / 8]), on_plane(SCAN[~near], [0, 0, 1 / 20])])
    rays = directions(np.array([-5.0, -0.1, 0.1, 5.0]), np.array([-2.0]))
    found = planes_at(rays, cloud)
    assert np.isnan(found[1:3]).all()
    assert found[[0, 3], 2] == pytest.approx([1 / 8, 1 / 20])


def test_there_is_none_where_points_are_far_few_or_to_one_side() -> None:
    cloud = on_plane(SCAN, np.array([0, 0, 0.05]))
    beyond = directions(np.array([0.0]), np.array([4.5]))  # above the highest beam, by 2 deg
    assert np.isnan(planes_at(beyond, cloud)).all()
    assert np.isnan(planes_at(directions(np.array([70.0]), np.array([0.0])), cloud)).all()
    inside = directions(np.array([0.0]), np.array([-2.0]))
    assert np.isnan(planes_at(inside, cloud[: NEIGHBOURS - 1])).all()
    assert planes_at(np.empty((0, 3)), cloud).shape == (0, 3)
    assert np.isnan(planes_at(inside, np.empty((0, 3)))).all()


def test_noise_averages_out() -> None:
    rng = np.random.default_rng(1)
    rays = directions(np.arange(-20, 20, 1.1), np.arange(-8, -1, 1.1))
    cloud = on_plane(SCAN, np.array([0, 0, 0.05]))
    cloud *= 1 + rng.normal(0, 0.02, (len(cloud), 1)) / np.linalg.norm(cloud, axis=1, keepdims=True)
    found = planes_at(rays, cloud)
    ranges, expected = 1 / (rays * found).sum(axis=1), 20 / rays[:, 2]
    assert np.isfinite(ranges).all()
    # 2 cm over 24 neighbours with falling weights: 0.5 cm, and 4 sigma of it for 200 features.
    assert np.abs(ranges - expected).max() < 0.03


def test_planes_move_between_frames_with_their_points() -> None:
    T_camera_lidar = np.eye(4)
    T_camera_lidar[:3, :3], T_camera_lidar[:3, 3] = FORWARD, [0.1, -0.3, 0.2]
    g = np.array([[0.1, 0.3, 0.05]])
    points = on_plane(SCAN, g[0])
    in_lidar = (invert(T_camera_lidar) @ np.column_stack([points, np.ones(len(points))]).T)[:3].T
    planes = planes_in_lidar(g, T_camera_lidar)
    assert in_lidar @ planes[0] == pytest.approx(np.ones(len(points)))
    distance = np.linalg.norm(points, axis=1)
    inverse = inverse_ranges(
        points / distance[:, None], np.repeat(planes, len(points), 0), T_camera_lidar
    )
    assert inverse == pytest.approx(1 / distance)
