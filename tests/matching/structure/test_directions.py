from __future__ import annotations

import numpy as np
import pytest

from calibgraph.matching.structure.directions import sphere_angles, thin, view_angles
from calibgraph.matching.structure.visibility import find_visible


def test_background_behind_a_near_object_is_hidden() -> None:
    wall = np.column_stack(
        [*(a.ravel() for a in np.mgrid[-2:2:0.05, -2:2:0.05]), np.full(6400, 20.0)]
    )
    post = np.column_stack([np.zeros(100), np.linspace(-0.4, 0.4, 100), np.full(100, 4.0)])
    points = np.vstack([wall, post])
    visible = find_visible(view_angles(points), np.linalg.norm(points, axis=1), np.radians(0.5))
    assert visible[-100:].all()
    behind = (np.abs(wall[:, 0]) < 0.04) & (np.abs(wall[:, 1]) < 1.5)
    assert not visible[:-100][behind].any()
    assert visible[:-100][np.abs(wall[:, 0]) > 0.5].all()


def test_thinned_directions_are_as_dense_everywhere() -> None:
    rng = np.random.default_rng(0)
    rays = rng.standard_normal((400_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    kept = rays[thin(sphere_angles(rays), 0.02)]
    cells = 2 * np.pi * (1 - np.cos(0.5)) / 0.02**2  # of a cone of 0.5 rad
    for axis in np.vstack([np.eye(3), -np.eye(3)]):
        assert np.count_nonzero(kept @ axis > np.cos(0.5)) == pytest.approx(cells, rel=0.1)
