from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Correspondences
from calibgraph.solver.augmented_fit import compensating_twists, fit_augmented, linearize
from calibgraph.solver.camera_twist import apply_twist, project_with_jacobian
from tests.conftest import make_camera, points_in_front


def test_the_fit_is_exact_without_noise() -> None:
    rng = np.random.default_rng(3)
    camera, points = make_camera(), points_in_front(rng, 300)
    column = rng.standard_normal((300, 2, 1))
    twist = 1e-4 * rng.standard_normal(6)
    pixels, jacobian = project_with_jacobian(camera, points)
    table = Correspondences.from_arrays(
        camera="front",
        frame=np.arange(300) % 5,
        pixels_px=pixels + jacobian @ twist + 0.7 * column[:, :, 0],
        points_lidar_m=points,
    )
    fit = fit_augmented(camera, table, column)
    assert fit is not None
    np.testing.assert_allclose(fit.values, [0.7], rtol=1e-9)
    np.testing.assert_allclose(fit.twist, twist, atol=1e-12)
    seen = project_with_jacobian(apply_twist(camera, fit.twist), points)[0]
    np.testing.assert_allclose(seen, pixels + jacobian @ twist, atol=1e-3)  # second order: 1e-7 f


def test_an_unknown_that_the_pose_compensates_is_not_fitted() -> None:
    points = points_in_front(np.random.default_rng(4), 100)
    pixels, jacobian = project_with_jacobian(make_camera(), points)
    table = Correspondences.from_arrays(
        camera="front", frame=0, pixels_px=pixels, points_lidar_m=points
    )
    assert fit_augmented(make_camera(), table, jacobian[:, :, :1]) is None


def test_compensating_twist_is_the_pose_that_imitates_an_unknown() -> None:
    rng = np.random.default_rng(5)
    camera, points = make_camera(), points_in_front(rng, 200)
    pixels, jacobian = project_with_jacobian(camera, points)
    table = Correspondences.from_arrays(
        camera="front", frame=0, pixels_px=pixels, points_lidar_m=points
    )
    twist = rng.standard_normal(6)
    found = compensating_twists(camera, table, (jacobian @ twist)[:, :, None])
    np.testing.assert_allclose(found[:, 0], twist, rtol=1e-9)


def test_rows_made_once_give_the_fit_of_every_choice_of_unknowns() -> None:
    rng = np.random.default_rng(6)
    camera, points = make_camera(), points_in_front(rng, 400)
    columns = rng.standard_normal((400, 2, 3))
    root = rng.uniform(0.5, 2, (400, 2))
    table = Correspondences.from_arrays(
        camera="front",
        frame=rng.integers(0, 7, 400),
        pixels_px=project_with_jacobian(camera, points)[0] + rng.standard_normal((400, 2)),
        points_lidar_m=points,
        information_px=np.column_stack([root[:, 0], 0.3 * np.ones(400), root[:, 1]]),
    )
    rows = linearize(camera, table, columns)
    for choice in ([0], [1, 2], [0, 1, 2]):
        alone = fit_augmented(camera, table, columns[:, :, choice])
        together = rows.fit(choice)
        assert alone is not None and together is not None
        np.testing.assert_array_equal(together.values, alone.values)
        np.testing.assert_array_equal(together.sigmas, alone.sigmas)


@pytest.mark.parametrize("inside", [0, 2])
def test_no_pose_compensates_where_too_few_rows_determine_one(inside: int) -> None:
    camera, points = make_camera(), points_in_front(np.random.default_rng(7), 50)
    pixels, jacobian = project_with_jacobian(camera, points)
    table = Correspondences.from_arrays(
        camera="front", frame=0, pixels_px=pixels, points_lidar_m=points
    )
    rows = linearize(camera, table, jacobian[:, :, :1])
    weights = (np.arange(50) < inside).astype(np.float64)
    assert np.isnan(rows.compensating_twists((0,), weights)).all()
