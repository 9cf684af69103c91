from __future__ import annotations

import numpy as np

from calibgraph.service.pick.advice import TOLERABLE, advise
from calibgraph.service.pick.estimate import estimate_from_pairs
from calibgraph.service.pick.views import visible_points
from calibgraph.simulation.rigs import rig_of
from tests.service.pick.builders import draw_pairs, pair_of, project

CAMERA = "image_2"


def test_a_pair_where_it_is_advised_reduces_the_weakest_direction_more_than_most() -> None:
    truth, rng = rig_of("kitti"), np.random.default_rng(1)
    pairs = draw_pairs(truth, CAMERA, 8, rng, noise_px=1.0, aside=(-0.6, -0.2))  # at the right
    found = estimate_from_pairs(truth, pairs).solve
    assert found is not None
    covariance = found.covariance_of(CAMERA)
    assert covariance is not None
    points = np.array([pair.point_lidar_m for pair in draw_pairs(truth, CAMERA, 300, rng)])
    camera = found.rig.cameras[CAMERA]
    seen = visible_points(points, camera)
    some = points[seen.rows]
    advice = advise(camera, covariance, found.scale, points_lidar_m=some, pixels_px=seen.pixels_px)
    assert advice is not None
    place = np.floor(3 * (seen.pixels_px + 0.5) / [camera.width_px, camera.height_px])
    there = (place == [advice.column, advice.row]).all(axis=1)
    left = np.array([weakest_with(truth, pairs, point) for point in some[::3]])
    assert np.median(left[there[::3]]) < np.quantile(left, 0.4)
    assert advice.words.startswith("pick something in the ")


def weakest_with(truth, pairs, point) -> float:  # type: ignore[no-untyped-def]
    """Largest standard deviation, in tolerable units, with one more exact pair."""
    pixel = project(truth, CAMERA, point[None])[0]
    solve = estimate_from_pairs(truth, [*pairs, pair_of(CAMERA, pixel, point)]).solve
    covariance = solve.covariance_of(CAMERA) / np.outer(TOLERABLE, TOLERABLE)
    return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1])) / solve.scale
