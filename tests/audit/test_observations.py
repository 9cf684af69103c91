"""Rows of any run as arrays: nulls, dates as text, columns that are not there."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from calibgraph.audit.observations import observe
from calibgraph.errors import CalibrationError
from calibgraph.fleet.page import STATES, payload, report_of
from calibgraph.fleet.rows import SCHEMA


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
    assert of.covariates == {}
    report = report_of(rows)
    assert [STATES[s] for s in report.state] == ["PASS", "WARN", "NO RESULT"]
    assert report.reasons == ["", "no error bar; few frames", "no images"]
    assert payload(report)["vehicles"] == ["a", "b"]


def test_columns_of_the_manifest_are_understood() -> None:
    of = observe(
        rows_of(
            model=[2024, 2024, None], date=["2026-03-01", "2026-03-02T12:00:00", None],
            mileage_km=[10, None, 30], seconds=[1.0, 2.0, 3.0],
            probability_off=[0.1, 0.2, None],
        )
    )  # fmt: skip
    assert of.model.tolist() == ["2024", "2024", ""]
    assert of.day[1] - of.day[0] == 1.5
    assert [*of.covariates] == ["mileage_km"]
    assert np.isnan(of.covariates["mileage_km"]).tolist() == [False, True, False]


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
    with pytest.raises(CalibrationError, match="vehicle 'a' are of mounts, those of 'a' of align"):
        observe(rows_of(of=["mount", None, None]))
