"""ROS bags on the command line: calibrate, match and report."""

from __future__ import annotations

from pathlib import Path

import pytest

from calibgraph import MatcherErrors, load_rig, simulate_correspondences
from tests.conftest import SAMPLE, Call
from tests.io.bags.writing import sample_bag


@pytest.mark.slow
def test_a_bag_is_calibrated_and_reported(call: Call, tmp_path: Path) -> None:
    truth, table = load_rig(SAMPLE / "reference.yaml"), tmp_path / "table.csv"
    errors = MatcherErrors(outlier_share=0.1)
    simulate_correspondences(truth, frames=6, errors=errors).save(table)
    bag, out = sample_bag(tmp_path, "ros1", raw=True), tmp_path / "out"
    code, _, err = call("calibrate", bag, "--matcher", table, "--out", out)
    assert code == 0, err
    assert "6 clouds, 6 with all images within 0.05 s; front_left +3 ms (median)" in err
    assert (out / "overlay_left.png").is_file()
    page = (out / "report.html").read_text()
    (out / "report.html").unlink()
    moved = bag.rename(tmp_path / f"moved{bag.suffix}")
    assert call("report", out, "--dataset", moved)[0] == 0
    assert page.count("data:image") == (out / "report.html").read_text().count("data:image")
