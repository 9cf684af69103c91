from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Camera, Correspondences
from calibgraph.solver.camera_twist import apply_twist, project_with_jacobian
from calibgraph.solver.linear_fit import LinearFit, block_of, fit_camera
from tests.conftest import make_camera, points_in_front


def table_of(
    pixels: np.ndarray, points: np.ndarray, frames: int, **more: object
) -> Correspondences:
    frame = np.arange(len(points)) % frames
    return Correspondences.from_arrays(
        camera="front", frame=frame, pixels_px=pixels, points_lidar_m=points, **more
    )


def fit_table(camera: Camera, table: Correspondences, fields: np.ndarray) -> LinearFit | None:
    rows = np.argsort(table.frame, kind="stable")
    return fit_camera(camera, block_of(camera, table), fields[:, :, rows])


def test_the_fit_is_exact_without_noise() -> None:
    rng = np.random.default_rng(3)
    camera, points = make_camera(), points_in_front(rng, 300)
    field = rng.standard_normal((1, 2, 300))
    twist = 1e-4 * rng.standard_normal(6)
    pixels, jacobian = project_with_jacobian(camera, points)
    table = table_of(pixels + jacobian @ twist + 0.7 * field[0].T, points, 5)
    fit = fit_table(camera, table, field)
    assert fit is not None
    freed = fit.free(0)
    np.testing.assert_allclose(freed.values, [0.7], rtol=1e-6)  # the weak prior is 1e-7 of it
    np.testing.assert_allclose(freed.twist, twist, atol=1e-9)
    seen = project_with_jacobian(apply_twist(camera, freed.twist), points)[0]
    np.testing.assert_allclose(seen, pixels + jacobian @ twist, atol=1e-3)  # second order: 1e-7 f


def test_an_unknown_that_the_pose_compensates_is_not_observable() -> None:
    points = points_in_front(np.random.default_rng(4), 100)
    pixels, jacobian = project_with_jacobian(make_camera(), points)
    field = jacobian[:, :, :1].transpose(2, 1, 0)
    fit = fit_table(make_camera(), table_of(pixels, points, 4), field)
    assert fit is not None
    assert fit.free(0).sigmas[0] > 0.99  # as the prior of the pose: a radian


def test_a_few_rows_and_a_single_frame_have_no_fit_and_no_sigma() -> None:
    rng = np.random.default_rng(8)
    points = points_in_front(rng, 100)
    pixels, field = (
        project_with_jacobian(make_camera(), points)[0],
        rng.standard_normal((1, 2, 100)),
    )
    table = table_of(pixels + rng.standard_normal((100, 2)), points, 1)
    assert fit_table(make_camera(), table.select(np.arange(20)), field[:, :, :20]) is None
    fit = fit_table(make_camera(), table, field)
    assert fit is not None and np.isnan(fit.free(0).sigmas).all()


def test_compensating_twist_undoes_what_an_unknown_displaces() -> None:
    rng = np.random.default_rng(5)
    camera, points = make_camera(), points_in_front(rng, 200)
    pixels, jacobian = project_with_jacobian(camera, points)
    twist = rng.standard_normal(6)
    fit = fit_table(camera, table_of(pixels, points, 4), (jacobian @ twist).T[None])
    assert fit is not None
    np.testing.assert_allclose(fit.free(0).compensating[:, 0], -twist, rtol=1e-5)


@pytest.mark.parametrize("outliers", [0, 90])
def test_sigmas_are_the_scatter_of_the_values(outliers: int) -> None:
    """Over 60 draws, 0.7 to 1.5 of it: four times the scatter of a standard deviation (9 %)."""
    rng = np.random.default_rng(7)
    camera, points = make_camera(), points_in_front(rng, 300)
    exact, field = project_with_jacobian(camera, points)[0], rng.standard_normal((1, 2, 300))
    values, sigmas = [], []
    for _ in range(60):
        pixels = exact + rng.standard_normal((300, 2))
        pixels[:outliers] += rng.uniform(-300, 300, (outliers, 2))
        fit = fit_table(camera, table_of(pixels, points, 30), field)
        assert fit is not None
        values.append(fit.free(0).values[0])
        sigmas.append(fit.free(0).sigmas[0])
    assert 0.7 < np.mean(sigmas) / np.sqrt(np.mean(np.square(values))) < 1.5


def test_what_is_considered_widens_an_unknown_by_its_scatter() -> None:
    """Over 200 draws, within a fifth: four times the scatter of a standard deviation (5 %)."""
    rng = np.random.default_rng(9)
    camera, points = make_camera(), points_in_front(rng, 300)
    exact, field = project_with_jacobian(camera, points)[0], rng.standard_normal((1, 2, 300))
    fields = np.concatenate([field, 0.5 * field + 0.1 * rng.standard_normal((2, 2, 300))])
    values, sigmas = [], []
    for _ in range(200):
        shifts = np.tensordot(rng.standard_normal(2), fields[1:], axes=1).T
        table = table_of(exact + shifts + 0.1 * rng.standard_normal((300, 2)), points, 30)
        rows = np.argsort(table.frame, kind="stable")
        fit = fit_camera(camera, block_of(camera, table), fields[:, :, rows], considered=2)
        assert fit is not None
        values.append(fit.free(0).values[0])
        sigmas.append(fit.free(0).sigmas[0])
    assert np.mean(sigmas) == pytest.approx(np.std(values), rel=0.2)
    assert np.mean(sigmas) > 0.6  # sqrt(2) / 2 of what is considered
