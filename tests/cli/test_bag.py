"""ROS bags on the command line: bag, calibrate and match."""

from __future__ import annotations

import json
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


def test_a_bag_is_listed_and_its_rig_is_written(call: Call, tmp_path: Path) -> None:
    bag, out = sample_bag(tmp_path, "sqlite3"), tmp_path / "rig.yaml"
    code, _, err = call("bag", bag, "--out", out)
    assert code == 0
    assert "/points  sensor_msgs/msg/PointCloud2  6\n" in err
    assert "left looks along LiDAR +y, 14 deg to the right" in err
    for name, camera in load_rig(SAMPLE).cameras.items():
        T = load_rig(out).cameras[name].T_camera_lidar
        np.testing.assert_allclose(T, camera.T_camera_lidar, atol=1e-12)
    code, stdout, err = call("bag", bag, "--json", "--tie-deg", 0.1, "--tie-m", 0.01)
    assert (code, err) == (0, "")
    found = json.loads(stdout)
    assert len(found["rig"]["relative_poses"]) == 2
    assert found["topics"][0] == {
        "topic": "/front_left/camera_info", "type": "sensor_msgs/msg/CameraInfo", "messages": 1
    }  # fmt: skip


def test_the_notes_about_a_bag_are_printed_and_in_the_json(call: Call, tmp_path: Path) -> None:
    make = Messages("mcap")
    written = sample_messages(make)
    for each in written:
        if each.topic == "/left/camera_info":  # of an image twice as large
            each.content.k[[0, 2, 4, 5]] *= 2
    lost = make.transforms([("base", "gps", np.eye(4))])
    lost.transforms[0].transform.rotation.w = 0.0
    written.append(Stamped("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, lost))
    bag = write_bag(tmp_path, "mcap", written)
    code, _, err = call("bag", bag)
    assert code == 0
    assert "the transform of frame 'gps' on /tf_static" in err
    assert "warning: left: principal point" in err
    code, stdout, err = call("bag", bag, "--json")
    assert (code, err) == (0, "")
    gps, left = json.loads(stdout)["notes"]
    assert "'gps'" in gps
    assert left.startswith("warning: left: principal point")


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
    options = ("match", bag, "--matcher", table, "--out", tmp_path / "table.parquet")
    line = error_line(*call(*options))
    assert "2 topics of clouds: /points (6), /rear_points (1); name the LiDAR's by" in line
    assert call(*options, "--topic", "lidar=/points")[0] == 0


def test_wrong_options_are_one_line(call: Call, tmp_path: Path, table: Path) -> None:
    bag, out = sample_bag(tmp_path, "mcap"), tmp_path / "out"
    for options, expected in (
        (("--topic", "/points"), "--topic /points: expected NAME=/TOPIC"),
        (("--stamps", "best"), "stamps 'best': known are header, record"),
        (("--tolerance-s", 0.001), "give --stamps record if the clocks differ"),
    ):
        assert expected in error_line(*call("calibrate", bag, "--out", out, *options))
    line = error_line(*call("calibrate", SAMPLE, "--out", out, "--every-s", 2))
    assert "options for ROS bags, such as --every-s, are given without a bag" in line
    assert "give both" in error_line(*call("bag", bag, "--tie-deg", 1))
    assert "is no ROS bag; expected a .bag" in error_line(*call("bag", table))
