"""Changes that are there are found, and none where there is none."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from calibgraph.fleet.findings import Finding, find_changes, moved_lidars
from calibgraph.fleet.model import fit_fleet
from calibgraph.fleet.observations import observe
from calibgraph.model.geometry import retract_all
from tests.draws.fleets import CAMERAS, simulate_fleet
from tests.fleet.conftest import Fitted


@pytest.fixture(scope="module")
def changes(fitted: Fitted) -> list[Finding]:
    return find_changes(fitted.model)


def test_a_changed_batch_a_date_and_a_drift_are_found(
    fitted: Fitted, changes: list[Finding]
) -> None:
    names = {(f.kind, f.model, f.camera, f.batch) for f in changes}
    assert {("batch", *fitted.truth.changed[::2], fitted.truth.changed[1])} <= names
    assert {("date", "van", "right", "B00"), ("drift", "compact", "rear", ""),
            ("drift", "van", "rear", "")} <= names  # fmt: skip


def test_size_and_date_of_a_change_are_measured(changes: list[Finding]) -> None:
    (step,) = [f for f in changes if f.kind == "date"]
    assert abs(step.change[1] - np.radians(0.5)) < 3.5 * step.sigma[1]
    assert "2026-06-20" < step.at < "2026-08-31"
    for drift in [f for f in changes if f.at == "mileage_km"]:
        assert abs(drift.change[0] - np.radians(0.15) / 1e5) < 3.5 * drift.sigma[0]


@pytest.mark.slow
def test_a_fleet_in_which_nothing_happened_has_no_findings() -> None:
    truth = simulate_fleet(np.random.default_rng(1), 150, change_deg=0.0)
    model = fit_fleet(observe(truth.rows))
    assert find_changes(model) == []
    assert moved_lidars(model) == []


def displaced(rows: pa.Table, chosen: np.ndarray, twists: np.ndarray) -> pa.Table:
    """The rows with some cameras moved in the LiDAR's axes: T exp(twist)."""
    T = observe(rows).T_camera_lidar
    T[chosen] = T[chosen] @ retract_all(np.tile(np.eye(4), (len(twists), 1, 1)), -twists)
    values = pa.FixedSizeListArray.from_arrays(pa.array(T.ravel()), 16)
    return rows.set_column(rows.column_names.index("T_camera_lidar"), "T_camera_lidar", values)


def test_a_moved_lidar_is_told_from_moved_cameras() -> None:
    rows = simulate_fleet(np.random.default_rng(4), 200, change_deg=0.0, moved_share=0.0).rows
    of = observe(rows)
    good = np.asarray(rows["verdict"].to_pylist()) == "PASS"
    vehicle = of.vehicle[good][0]
    chosen = of.vehicle == vehicle
    turned = displaced(rows, chosen, np.radians([[1.5, 1.5, 1.5, 0, 0, 0]]))
    assert moved_lidars(fit_fleet(observe(turned))) == [vehicle]


def test_a_mount_that_moves_in_many_vehicles_is_found() -> None:
    rng = np.random.default_rng(5)
    rows = simulate_fleet(rng, 200, change_deg=0.0, moved_share=0.0).rows
    of = observe(rows)
    chosen = (of.camera == CAMERAS[4]) & (of.model == "van") & (rng.random(len(rows)) < 0.25)
    moves = rng.normal(size=(chosen.sum(), 6)) * np.radians([1, 1, 1, 0, 0, 0])
    found = find_changes(fit_fleet(observe(displaced(rows, chosen, moves))))
    assert [(f.kind, f.model, f.camera) for f in found] == [("mount", "van", CAMERAS[4])]
    assert found[0].text.startswith("van rear: the mount moved in ")


@pytest.mark.statistics
def test_findings_of_quiet_fleets_are_as_rare_as_promised() -> None:
    """A family of tests has a false report with a probability of 1 %: 30 fleets, at most 3."""
    wrong = 0
    for seed in range(30):
        truth = simulate_fleet(np.random.default_rng(seed), 200, change_deg=0.0)
        wrong += bool(find_changes(fit_fleet(observe(truth.rows))))
    assert wrong <= 3
