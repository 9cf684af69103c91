"""What the fleet's model learns from vehicles whose deviations are known, from rows of any run."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pytest

from calibgraph.audit.fleet_model import FleetModel, fit_fleet, moved_lidars, newest_rows, observe
from calibgraph.errors import CalibrationError
from calibgraph.fleet.files import SCHEMA
from calibgraph.fleet.page import STATES, report_of
from calibgraph.model.geometry import retract_all, twists_between
from tests.draws.fleets import SPREAD, Fleet, errors_of, simulate_fleet


@dataclass(frozen=True)
class Fitted:
    truth: Fleet
    model: FleetModel


@pytest.fixture(scope="module")
def fitted() -> Fitted:
    """500 vehicles, 5 % of cameras moved."""
    truth = simulate_fleet(np.random.default_rng(0), 500)
    return Fitted(truth, fit_fleet(observe(truth.rows)))


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
    mounts = [mount for each in fitted.model.mounts.values() for mount in each.values()]
    spreads = [mount.spread for mount in mounts]
    ratios = np.sqrt(np.array([np.diag(spread) for spread in spreads])) / SPREAD
    assert np.abs(ratios - 1).max() < 3.5 * 0.047
    assert abs(ratios.mean() - 1) < 3 * 0.047 / np.sqrt(ratios.size)


def test_a_camera_without_a_result_has_the_nominal_pose_with_the_spread_of_vehicles() -> None:
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
    assert model.mounts == {}
    assert np.array_equal(model.T_camera_lidar, model.observations.T_camera_lidar)
    assert np.isnan(model.deviation).all()


def test_of_several_rows_of_a_camera_the_newest_counts() -> None:
    rows = simulate_fleet(np.random.default_rng(0), 3).rows
    old = rows.set_column(rows.column_names.index("date"), "date",
                          [[np.datetime64("2024-01-01", "us")] * 18])  # fmt: skip
    both = pa.concat_tables([rows, old])
    assert newest_rows(both).sort_by("vehicle")["date"].to_pylist() == rows["date"].to_pylist()


def displaced(rows: pa.Table, chosen: np.ndarray, twists: np.ndarray) -> pa.Table:
    """The rows with some cameras moved in the LiDAR's axes: T exp(twist)."""
    T = observe(rows).T_camera_lidar
    T[chosen] = T[chosen] @ retract_all(np.tile(np.eye(4), (len(twists), 1, 1)), -twists)
    values = pa.FixedSizeListArray.from_arrays(pa.array(T.ravel()), 16)
    return rows.set_column(rows.column_names.index("T_camera_lidar"), "T_camera_lidar", values)


def test_a_moved_lidar_is_told_from_moved_cameras() -> None:
    rows = simulate_fleet(np.random.default_rng(4), 200, moved_share=0.0).rows
    of = observe(rows)
    good = np.asarray(rows["verdict"].to_pylist()) == "PASS"
    vehicle = of.vehicle[good][0]
    chosen = of.vehicle == vehicle
    turned = displaced(rows, chosen, np.radians([[1.5, 1.5, 1.5, 0, 0, 0]]))
    assert moved_lidars(fit_fleet(observe(turned))) == [vehicle]


def rows_of(**columns: list[object]) -> pa.Table:
    """Three rows as `fleet` writes them: a result, one without an error bar, a failed vehicle."""
    given: dict[str, list[object]] = {
        "vehicle": ["a", "a", "b"], "camera": ["front", "rear", ""],
        "status": ["done", "done", "failed"], "verdict": ["PASS", "WARN", None],
        "reasons": [[], ["few frames"], None], "error": [None, None, "no images"],
        "T_camera_lidar": [np.eye(4).ravel().tolist()] * 2 + [None],
        "covariance": [np.eye(6).ravel().tolist(), None, None],
        **columns,
    }  # fmt: skip
    fields = [field for field in SCHEMA if field.name in given]
    arrays = {field.name: pa.array(given.pop(field.name), field.type) for field in fields}
    return pa.table({**arrays, **{name: pa.array(values) for name, values in given.items()}})


def test_rows_without_a_result_measure_nothing() -> None:
    rows = rows_of()
    of = observe(rows)
    assert of.measured.tolist() == [True, False, False]
    assert np.isnan(of.day).all()
    report = report_of(rows)
    assert [STATES[s] for s in report.state] == ["PASS", "WARN", "NO RESULT"]
    assert report.reasons == ["", "no error bar; few frames", "no images"]


def test_columns_of_the_manifest_are_understood() -> None:
    of = observe(
        rows_of(
            model=[2024, 2024, None], date=["2026-03-01", "2026-03-02T12:00:00", None]
        )
    )  # fmt: skip
    assert of.model.tolist() == ["2024", "2024", ""]
    assert of.day[1] - of.day[0] == 1.5


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (pa.table({"vehicle": ["a"]}), "has no column 'camera', found vehicle; give the folder"),
        (rows_of(date=["yesterday", "", ""]), "column 'date' holds what is no date"),
    ],
)
def test_wrong_tables_are_one_line(rows: pa.Table, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        observe(rows)


def test_mounts_are_not_mixed_with_alignments() -> None:
    """Rows without the column are alignments; a failed row is neither."""
    assert observe(rows_of(of=["mount", "mount", None])).measured.any()
    with pytest.raises(CalibrationError, match="vehicle 'a' has mounts and vehicle 'a' has align"):
        observe(rows_of(of=["mount", None, None]))
