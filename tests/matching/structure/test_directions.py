from __future__ import annotations

import numpy as np

from calibgraph.matching.structure.directions import find_visible, thin, view_angles


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


def test_thinning_is_independent_of_the_order_of_points() -> None:
    rng = np.random.default_rng(0)
    angles = rng.uniform(-0.5, 0.5, (10_000, 2))
    order = rng.permutation(10_000)
    one, two = thin(angles, 0.05), thin(angles[order], 0.05)
    assert len(one) == 400
    np.testing.assert_array_equal(angles[one], angles[order][two])
