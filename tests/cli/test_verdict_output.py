"""What the command line and the files show of a verdict."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import calibgraph
from calibgraph import Rig, simulate_correspondences
from tests.cli.conftest import words_to_solve
from tests.conftest import Call


def test_a_warning_for_lack_of_data_is_told_from_one_that_looks_odd(
    call: Call, tmp_path: Path, pair: Rig
) -> None:
    """In the terminal, in JSON, in the file and on the page; the exit code is that of a WARN."""
    command, out = words_to_solve(tmp_path, pair, frames=3, matches=60), tmp_path / "out"
    code, _, text = call(*command)
    assert code == 0
    lines = text.splitlines()
    assert lines[0] == "WARN" or lines[0].startswith("WARN: off by more than 0.5 deg or 10 cm")
    assert lines[1].startswith("  WARN  left, right: cannot tell: ")
    assert "What to do:" in lines and "?" not in text and "CANNOT TELL" not in text
    summary = yaml.safe_load(call(*command, "--json")[1])
    assert (summary["verdict"], summary["cannot_tell"]) == ("WARN", True)
    assert summary["summary"]["reasons"][0]["text"].startswith("cannot tell: ")
    page = (out / "report.html").read_text()
    assert "<title>WARN" in page and "cannot tell: " in page and "CANNOT TELL" not in page
    content = yaml.safe_load((out / "calibration.yaml").read_text())
    assert (content["verdict"]["cannot_tell"], content["summary"]) == (True, summary["summary"])


def test_the_common_error_of_a_table_without_one_is_an_option(
    call: Call, tmp_path: Path, pair: Rig
) -> None:
    pair.save(tmp_path / "rig.yaml")
    simulate_correspondences(pair, frames=8, matches=100).save(tmp_path / "table.csv")
    command = ("solve", tmp_path / "rig.yaml", tmp_path / "table.csv", "--out", tmp_path / "out")
    assert "cannot tell: scatter only: " in call(*command)[2]
    code, _, text = call(*command, "--common-deg", 0.05, "--common-cm", 1)
    assert code == 0 and text.startswith("PASS\n")
    assert "Least certain: " in text


@pytest.mark.parametrize("preset", ["auto", "kitti"])
def test_the_time_offset_is_said_to_be_left_out_where_it_is(preset: str, pair: Rig) -> None:
    """It is in the bar where the motion is known: 5 ms at 5 m/s are 2.5 cm ahead."""
    table, config = simulate_correspondences(pair, frames=8, matches=100), calibgraph.preset(preset)
    moving = replace(table, twist_per_s=np.tile([0, 0, 0, 5.0, 0, 0], (len(table), 1)))
    still, moved = (calibgraph.solve(pair, each, config) for each in (table, moving))
    bars_cm = [result.error_bar("left")[1][2] for result in (still, moved)]
    assert np.sqrt(bars_cm[1] ** 2 - bars_cm[0] ** 2) == pytest.approx(2.5, rel=0.1)
    assert "time offset" in still.not_included and "time offset" not in moved.not_included
