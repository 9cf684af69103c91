"""The row of a camera over all starts."""

from __future__ import annotations

from typing import Any

from benchmarks.accuracy.ledger import Record
from benchmarks.accuracy.search import per_camera


def start(seed: int, status: str, xi_deg: float, *, places: int | None = 2) -> Record:
    camera: dict[str, Any] = {
        "status": status, "error_deg": xi_deg, "error_cm": 3.0,
        "xi_deg": [xi_deg, 0.0, 0.1], "xi_cm": [3.0, 0.0, 0.0],
        "sigma_deg": [0.1, 0.1, 0.1], "sigma_cm": [1.0, 2.0, 1.0], "normalised_squared": 1.5,
    }  # fmt: skip
    key = {"level": "20/1.5", "kind": "good", "data": "05", "seed": seed}
    return {**key, "places": places, "cameras": {"left": camera}}


def row(records: list[Record]) -> dict[str, str]:
    table = per_camera(records)
    (cells,) = table.rows
    return dict(zip(table.columns, cells, strict=True))


def test_sigmas_and_squared_errors_are_of_results_that_are_no_fail() -> None:
    found = row([start(0, "PASS", 0.1), start(1, "WARN", 0.3), start(2, "FAIL", 9.0)])
    assert found["squared error over variance: rotation x, y, z"] == "5.0, 0.0, 1.0"  # (1 + 9) / 2
    assert found["translation x, y, z"] == "9.0, 0.0, 0.0"
    assert found["sigma [deg]"] == "0.10" and found["in the covariance, over 6"] == "1.5"
    assert found["median [deg]"] == "0.30"  # of all three
