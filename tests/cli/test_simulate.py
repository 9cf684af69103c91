"""The command ``simulate``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph.simulation.rigs import rig_of
from calibgraph.simulation.scenarios import SCENARIOS, draw_scenario
from tests.conftest import Call


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_command_writes_a_table_and_a_guess_that_is_off(
    name: str, tmp_path: Path, call: Call
) -> None:
    folder = tmp_path / "sim"
    code, _, text = call("simulate", name, "--frames", 3, "--out", folder)
    assert code == 0, text
    table = calibgraph.load_correspondences(folder / "correspondences.parquet")
    truth = calibgraph.load_rig(folder / "reference.yaml")
    assert set(table.cameras) == set(truth.cameras) == set(rig_of(name).cameras)
    for name_, error in calibgraph.evaluate(
        calibgraph.load_rig(folder / "rig.yaml"), truth
    ).cameras.items():
        assert error.rotation_error_deg == pytest.approx(5, abs=1e-6), name_
    code, _, text = call("simulate", name, "--frames", 3, "--out", folder)
    assert code == 2 and "holds files, but no" in text
    again = draw_scenario(name, 3, 0)
    np.testing.assert_array_equal(again.pixels_px, table.pixels_px)
