"""What the fleet's model learns from 500 vehicles whose deviations are known."""

from __future__ import annotations

import gtsam
import numpy as np
import pyarrow as pa
import pytest

from calibgraph.fleet.deviations import Centers, measured_batches, solve_centers
from calibgraph.fleet.model import fit_fleet
from calibgraph.fleet.observations import newest_rows, observe
from calibgraph.model.geometry import retract_all, to_T_lidar_camera, twists_between
from tests.draws.fleets import SPREAD, Fleet, errors_of, simulate_fleet
from tests.fleet.conftest import Fitted


def nees(fitted: Fitted) -> np.ndarray:
    """(n,) normalised squared errors of the shrunk estimates, over 6."""
    xi = twists_between(fitted.truth.T_camera_lidar, fitted.model.T_camera_lidar)
    squared = np.einsum("ni,nij,nj->n", xi, np.linalg.inv(fitted.model.covariance), xi)
    return np.asarray(squared / 6)


def test_errors_of_poorly_observed_vehicles_are_more_than_halved(fitted: Fitted) -> None:
    truth, model, poor = fitted.truth, fitted.model, fitted.truth.poor
    alone = errors_of(model.observations.T_camera_lidar, truth.T_camera_lidar)
    shrunk = errors_of(model.T_camera_lidar, truth.T_camera_lidar)
    assert np.sqrt((shrunk[poor] ** 2).mean()) < 0.5 * np.sqrt((alone[poor] ** 2).mean())
    assert np.sqrt((shrunk[~poor] ** 2).mean()) < np.sqrt((alone[~poor] ** 2).mean())


def test_error_bars_of_shrunk_estimates_hold(fitted: Fitted) -> None:
    values, poor = nees(fitted), fitted.truth.poor
    for chosen in (poor, ~poor):
        assert 0.8 < values[chosen].mean() < 1.25


def test_moved_cameras_stand_apart_and_others_do_not(fitted: Fitted) -> None:
    """Three standard deviations of a binomial count about what is expected."""
    apart, moved, poor = fitted.model.apart, fitted.truth.moved, fitted.truth.poor
    assert (apart & moved & ~poor).sum() >= 0.97 * (moved & ~poor).sum()
    expected = 0.01 * apart.sum()
    assert (apart & ~moved).sum() <= expected + 3 * np.sqrt(expected)


def test_the_spread_of_vehicles_is_learnt(fitted: Fitted) -> None:
    """Of about 230 vehicles a standard deviation is known to 1 / sqrt(2 * 230), 4.7 %."""
    mounts = [mount for model in fitted.model.models.values() for mount in model.mounts.values()]
    spreads = [mount.spread for mount in mounts if mount.camera not in ("rear", "right")]
    ratios = np.sqrt(np.array([np.diag(spread) for spread in spreads])) / SPREAD
    assert np.abs(ratios - 1).max() < 3.5 * 0.047
    assert abs(ratios.mean() - 1) < 3 * 0.047 / np.sqrt(ratios.size)


def test_a_camera_without_a_result_has_its_batchs_pose_with_the_spread_of_vehicles() -> None:
    truth = simulate_fleet(np.random.default_rng(3), 60, moved_share=0.0)
    rows = truth.rows.slice(0, 354)  # the last vehicle is left out
    lost = truth.rows.slice(354).set_column(
        truth.rows.column_names.index("verdict"), "verdict", [["FAIL"] * 6]
    )
    model = fit_fleet(observe(pa.concat_tables([rows, lost])))
    xi = twists_between(truth.T_camera_lidar, model.T_camera_lidar)[354:]
    sigma = np.sqrt(np.diagonal(model.covariance[354:], axis1=1, axis2=2))
    assert (sigma[:, :3] > np.radians(0.1)).all()
    assert (sigma[:, :3] < np.radians(0.5)).all()
    assert np.abs(xi / sigma).max() < 4
    assert not model.apart[354:].any()


def test_few_vehicles_of_a_model_stay_as_they_are() -> None:
    rows = simulate_fleet(np.random.default_rng(0), 4).rows
    model = fit_fleet(observe(rows))
    assert model.models == {}
    assert np.array_equal(model.T_camera_lidar, model.observations.T_camera_lidar)
    assert np.isnan(model.deviation).all()


def test_sums_over_vehicles_are_the_graph_with_a_variable_per_vehicle() -> None:
    """The stock graph: a prior per measurement, a between factor per vehicle and batch."""
    rng, spread = np.random.default_rng(1), np.diag([0.002, 0.003, 0.002, 0.01, 0.02, 0.01]) ** 2
    nominal = retract_all(np.eye(4)[None], rng.normal(size=(1, 6)))[0]
    batch, noise = np.repeat([0, 1], [3, 5]), spread * rng.uniform(0.1, 9, (8, 1, 1))
    small = rng.normal(size=(8, 6)) * np.sqrt(np.diag(spread)) * 1e-3  # to first order
    T = retract_all(np.repeat(nominal[None], 8, axis=0), small)
    between = np.repeat(0.3 * spread[None], 2, axis=0)
    start = Centers(nominal, spread, np.repeat(nominal[None], 2, axis=0), between)

    information = np.linalg.inv(noise + spread)
    each = np.einsum("nij,nj->ni", information, twists_between(T, nominal))
    sums = [np.array([of[batch == b].sum(axis=0) for b in (0, 1)]) for of in (information, each)]
    measured = measured_batches(start.batches, *sums)
    found = solve_centers(start, measured, between)

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    for key in range(11):
        values.insert(key, to_T_lidar_camera(nominal))
    for b in (0, 1):
        graph.add(gtsam.BetweenFactorPose3(0, 1 + b, gtsam.Pose3(), gaussian(between[b])))
    for v in range(8):
        graph.add(
            gtsam.BetweenFactorPose3(1 + int(batch[v]), 3 + v, gtsam.Pose3(), gaussian(spread))
        )
        graph.add(gtsam.PriorFactorPose3(3 + v, to_T_lidar_camera(T[v]), gaussian(noise[v])))
    stock = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, stock)
    for key, pose, bar in zip(
        range(3), [found.nominal, *found.batches],
        [found.nominal_covariance, *found.batch_covariance], strict=True,
    ):  # fmt: skip
        assert np.allclose(to_T_lidar_camera(pose).matrix(), stock.atPose3(key).matrix(), atol=1e-9)
        assert np.allclose(bar, marginals.marginalCovariance(key), rtol=1e-5, atol=1e-12)


def test_of_several_rows_of_a_camera_the_newest_counts() -> None:
    rows = simulate_fleet(np.random.default_rng(0), 3).rows
    old = rows.set_column(rows.column_names.index("date"), "date",
                          [[np.datetime64("2024-01-01", "us")] * 18])  # fmt: skip
    both = pa.concat_tables([rows, old])
    assert newest_rows(both).sort_by("vehicle")["date"].to_pylist() == rows["date"].to_pylist()
    assert newest_rows(both, days_ago=366)["date"].to_pylist() == old["date"].to_pylist()


@pytest.mark.statistics
@pytest.mark.parametrize("seed", range(10))
def test_error_bars_hold_over_many_fleets(seed: int) -> None:
    truth: Fleet = simulate_fleet(np.random.default_rng(seed), 500)
    fitted = Fitted(truth, fit_fleet(observe(truth.rows)))
    for chosen in (truth.poor, ~truth.poor):
        assert 0.8 < nees(fitted)[chosen].mean() < 1.25
