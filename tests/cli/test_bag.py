"""ROS bags on the command line: calibrate, match and report."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibgraph import MatcherErrors, load_rig, simulate_correspondences
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call
from tests.io.bags.writing import (
    START_NS,
    Messages,
    Stamped,
    sample_bag,
    sample_messages,
    structured,
    write_bag,
)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """Correspondences that are the truth and a pixel of noise."""
    truth = load_rig(SAMPLE / "reference.yaml")
    errors = MatcherErrors(outlier_share=0.1)
    simulate_correspondences(truth, frames=6, errors=errors).save(tmp_path / "table.csv")
    return tmp_path / "table.csv"


@pytest.mark.slow
def test_a_bag_is_calibrated_and_reported(call: Call, tmp_path: Path, table: Path) -> None:
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


def test_the_clouds_topic_is_asked_for_and_taken_by_name(
    call: Call, tmp_path: Path, table: Path
) -> None:
    make = Messages("mcap")
    second = make.cloud(structured(np.ones((9, 4), np.float32)), START_NS)
    other = Stamped("/rear_points", "sensor_msgs/msg/PointCloud2", START_NS, second)
    bag = write_bag(tmp_path, "mcap", [*sample_messages(make), other])
    options = ("match", bag, "--matcher", table, "--out", tmp_path / "found.parquet")
    line = error_line(*call(*options))
    assert "2 topics of clouds: /points (6), /rear_points (1); name the LiDAR's by" in line
    assert call(*options, "--topic", "lidar=/points")[0] == 0
