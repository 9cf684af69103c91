"""The page of a fleet: small, quick, without a network."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph.fleet.files import ROWS, Store
from calibgraph.fleet.page import STATES, report_of, write_fleet_report
from tests.chromium import render
from tests.draws.fleets import SPREAD, simulate_fleet

HOSTILE = "</script><b>x"


def column(rows: pa.Table, name: str, values: object) -> pa.Table:
    index = rows.column_names.index(name)
    return rows.set_column(index, name, pa.array(values, rows.schema.field(name).type))


@pytest.fixture(scope="module")
def rows() -> pa.Table:
    """Vehicle 0 failed, vehicle 1 has FAIL; nothing else but 5 % of cameras moved."""
    table = simulate_fleet(np.random.default_rng(7), 120).rows
    verdict, status = table["verdict"].to_pylist(), table["status"].to_pylist()
    status[:6], verdict[6:12] = ["failed"] * 6, ["FAIL"] * 6
    return column(column(table, "status", status), "verdict", verdict)


def page_of(rows: pa.Table, folder: Path) -> Path:
    """The page of rows in a folder, beside them."""
    Store(str(folder)).put(f"{ROWS}/all.parquet", rows)
    write_fleet_report(str(folder))
    return folder / "fleet.html"


@pytest.fixture(scope="module")
def page(rows: pa.Table, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of these rows; the first vehicle has a name that would end the script."""
    hostile = column(rows, "vehicle", [HOSTILE] * 6 + rows["vehicle"].to_pylist()[6:])
    hostile = column(hostile, "model", ["\u202e"] * 6 + rows["model"].to_pylist()[6:])
    return page_of(hostile, tmp_path_factory.mktemp("page"))


def test_states_follow_status_verdict_and_deviation(rows: pa.Table) -> None:
    report = report_of(rows)
    fleet, states = report.fleet, np.array(STATES)[report.state]
    assert set(states[:6]) == {"NO RESULT"}
    assert set(states[6:12]) == {"FAIL"}
    verdict = np.asarray(rows["verdict"].to_pylist())[12:]
    assert (states[12:][fleet.apart[12:]] == "FAIL").all()
    assert (states[12:][~fleet.apart[12:] & (verdict == "WARN")] == "WARN").all()
    assert (states[12:][~fleet.apart[12:] & (verdict == "PASS")] == "PASS").all()


def test_a_browser_shows_it_without_errors_and_without_a_network(browser: Any, page: Path) -> None:
    rendering = render(browser, page)
    assert rendering.errors == []
    assert "<td>\\u202e</td>" in page.read_text() and "\u202e" not in page.read_text()
    assert rendering.requests == []
    red = (rendering.picture == (0x20, 0, 0xB0)).all(axis=2)  # BGR
    assert red.sum() > 1000


def test_states_and_words_choose_vehicles(browser: Any, page: Path, rows: pa.Table) -> None:
    script = """() => {
      const shown = () => document.getElementById("shown").textContent, found = [shown()];
      const type = (text) => { search.value = text; search.oninput(); found.push(shown()); };
      type("v000001 "); type("");
      buttons.find((button) => button.value === "NO RESULT").click(); found.push(shown());
      found.push(rows.find((row) => !row.hidden).cells[1].textContent);
      return found; }"""
    report = report_of(rows)
    bad = len({*report.fleet.observations.vehicle[report.state > 0].tolist()})
    shown = [f"{bad} of {bad}", f"1 of {bad}"] * 2
    assert render(browser, page).page.evaluate(script) == [*shown, HOSTILE]
    assert re.search(r"moved in its mount by 0\.\d+ deg, \d", page.read_text())


def test_the_model_is_written_beside_the_page(page: Path) -> None:
    known = json.loads((page.parent / "fleet_model.json").read_text())
    (mount,) = {n: m for n, m in known["models"]["van"]["cameras"].items() if n == "left"}.values()
    spread = np.sqrt(np.diag(mount["spread"]))
    assert np.abs(spread / SPREAD - 1).max() < 0.5  # of about 55 vehicles: five sigma
    estimates = parquet.read_table(page.parent / "estimates.parquet")
    assert len(estimates) == 720
    write_fleet_report(str(page.parent))  # its own files are no rows
