"""rig, from a folder to fill in, a bag, or files of other programs; export; the way between."""

import json
import re
import shutil
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from calibgraph import load_calibration, load_rig, write_rig_template
from tests.cli.conftest import error_line
from tests.conftest import ROOT, SAMPLE, Call, require_near, require_poses
from tests.io.bags.writing import (
    START_NS,
    Messages,
    Stamped,
    sample_bag,
    sample_messages,
    without,
    write_bag,
)
from tests.io.formats.calibration_files import CAMERA_INFO, KALIBR, KOIDE, SENTENCE, URDF, write
from tests.io.formats.readers import READERS


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """The sample without a rig."""
    folder = tmp_path / "drive"
    for name in ("lidar", "cameras"):
        shutil.copytree(SAMPLE / name, folder / name)
    return folder


def test_the_file_has_the_cameras_and_image_sizes_of_the_folder(
    recording: Path, call: Call
) -> None:
    code, out, err = call("rig", recording)
    assert (code, out) == (0, "") and f"{recording / 'rig.yaml'}: written" in err
    cameras = yaml.safe_load((recording / "rig.yaml").read_text())["cameras"]
    assert list(cameras) == ["front_left", "front_right", "left"]
    assert {(c["width_px"], c["height_px"]) for c in cameras.values()} == {(640, 360)}


@pytest.mark.parametrize("command", ["calibrate", "match"])
def test_an_unfilled_file_is_refused_with_the_key_that_is_left(
    recording: Path, call: Call, command: str
) -> None:
    write_rig_template(recording)
    line = error_line(*call(command, recording, "--out", recording.parent / "out.parquet"))
    assert "cameras.front_left.intrinsics_px.fx is still FILL_IN, and 17 more keys" in line


def test_a_file_that_is_there_is_replaced_only_with_force(recording: Path, call: Call) -> None:
    mine = recording / "rig.yaml"
    mine.write_text("mine: 1\n")
    assert "is there already" in error_line(*call("rig", recording))
    assert mine.read_text() == "mine: 1\n"
    assert call("rig", recording, "--force")[0] == 0
    assert mine.read_text().startswith("# Replace every FILL_IN")


@pytest.mark.parametrize(
    ("how", "focal_px"), [("90 deg", 320.0), ("53.13°", 640.0), ("4 mm 8 um", 500.0)]
)
def test_a_lens_in_words_is_computed_with_what_is_uncertain_of_it(
    recording: Path, call: Call, how: str, focal_px: float
) -> None:
    code, _, err = call("rig", recording, "--lens", how, "--mount", "left=left",
                        "--mount", "front_left=front", "--mount", "front_right=front")  # fmt: skip
    assert code == 0
    assert f"next: calibgraph doctor {recording}" in err
    assert f"calibgraph calibrate {recording} --estimate lens" in err
    for camera in load_rig(recording).cameras.values():
        k, sigma = camera.intrinsics_px, camera.intrinsics_sigma_px
        assert k.fx == k.fy == pytest.approx(focal_px, abs=0.01)
        assert (k.cx, k.cy, camera.distortion) == (319.5, 179.5, ())
        assert sigma is not None and sigma.centre == 5.0
        assert sigma.focal == pytest.approx(0.02 * focal_px, abs=0.01)
        assert camera.distortion_sigma == 0.05


def test_a_bag_is_listed_and_its_rig_is_written(call: Call, tmp_path: Path) -> None:
    bag, out = sample_bag(tmp_path, "sqlite3"), tmp_path / "rig.yaml"
    code, _, err = call("rig", bag, "--out", out)
    assert code == 0
    assert "/points  sensor_msgs/msg/PointCloud2  6\n" in err
    assert "left looks along LiDAR +y, 14 deg to the right" in err
    require_poses(load_rig(out).T_camera_lidar, load_rig(SAMPLE).T_camera_lidar, atol=1e-12)
    code, stdout, err = call("rig", bag, "--json")
    assert (code, err) == (0, "")
    found = json.loads(stdout)
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
    code, _, err = call("rig", bag)
    assert code == 0
    assert "the transform of frame 'gps' on /tf_static" in err
    assert "warning: left: principal point" in err
    code, stdout, err = call("rig", bag, "--json")
    assert (code, err) == (0, "")
    gps, left = json.loads(stdout)["notes"]
    assert "'gps'" in gps
    assert left.startswith("warning: left: principal point")


FILES_OF_OTHERS = """
info.yaml car.urdf | front | {sentence}
info.yaml turned.urdf | front | sits 0.40 m ahead
nose=info.yaml car.urdf --camera-frame nose=front_link --lidar-frame base_link | nose | 1.40 m ahead
front=calib.json --size 1646x1240 | front | front looks along LiDAR +x
chain.yaml --rename cam0=left --rename cam1=right | left right | left sits 0.11 m left of right
"""


@pytest.mark.parametrize("line", FILES_OF_OTHERS.strip().splitlines())
def test_files_of_others_make_a_rig_and_print_a_sentence_per_camera(
    line: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    turned = URDF.replace('rpy="0 0 0"', 'rpy="0 0 6.2832"')  # by radians
    write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=URDF, turned__urdf=turned,
          chain__yaml=KALIBR, calib__json=json.dumps(KOIDE))  # fmt: skip
    words, names, said = (part.strip() for part in line.split("|"))
    code, stdout, err = call("rig", *words.split(), "--out", "rig.yaml")
    assert (code, stdout) == (0, ""), err
    assert said.format(sentence=SENTENCE) in " ".join(err.split())
    assert f"\n{err.splitlines()[-1]}\n```" in (ROOT / "docs/formats.md").read_text()
    assert [*load_rig("rig.yaml").cameras] == names.split()


def test_millimetres_are_warned_of_by_rig_and_export(call: Call, tmp_path: Path) -> None:
    far = URDF.replace('xyz="1.4 0.1 1.8"', 'xyz="400 100 -200"')
    info, car = write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=far)
    said = "warning: front: the camera is 458 m from the LiDAR: lengths in millimetres"
    code, _, err = call("rig", info, car, "--out", tmp_path / "rig.yaml")
    assert (code, err.count(said)) == (0, 1)
    pose = ("--lidar-pose", "0 0 1800 0 0 0")
    code, _, err = call("export", tmp_path / "rig.yaml", "--format", "autoware", "--out",
                        tmp_path / "kit.yaml", *pose)  # fmt: skip
    assert (code, err.count(said)) == (0, 1)
    assert "warning: --lidar-pose '0 0 1800 0 0 0': lengths in millimetres?" in err


MOUNTED = {"front_left": "front, 0.4 m ahead", "front_right": "front, 0.4 m ahead", "left": "left"}


@pytest.mark.slow
def test_a_bag_without_transforms(call: Call, tmp_path: Path) -> None:
    """The second command is as the first proposed it; frames are those of the bag."""
    bag = write_bag(tmp_path, "mcap", without(sample_messages(Messages("mcap")), "/tf_static"))
    rig, out, launch = tmp_path / "rig.yaml", tmp_path / "result", tmp_path / "rig.launch.xml"
    words = [part for name, text in MOUNTED.items() for part in ("--mount", f"{name}={text}")]
    code, _, said = call("rig", bag, *words, "--out", rig)
    proposed = re.search(r"--search-deg \S+ --search-m \S+", said)
    assert code == 0 and proposed is not None
    assert call("calibrate", bag, "--rig", rig, *proposed[0].split(), "--out", out)[0] == 0
    assert call("export", out, "--format", "ros2-launch", "--out", launch)[0] == 0
    nodes = ElementTree.parse(launch).getroot().iter("node")
    frames = [node.attrib["args"].split()[-1] for node in nodes]
    assert frames == [f"{name}_optical" for name in MOUNTED]
    truth = load_rig(SAMPLE / "reference.yaml")
    # 1 px
    require_near(load_calibration(out).rig, truth, deg=0.12, cm=3)


def test_a_rig_is_exported_and_the_file_named(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "robot.urdf"
    code, stdout, err = call("export", SAMPLE, "--format", "urdf", "--out", out)
    assert (code, stdout, err) == (0, "", f"{out}: written (urdf)\n")
    require_poses(READERS["urdf"](out), load_rig(SAMPLE).T_camera_lidar, atol=1e-9)


def test_options_of_export_reach_the_file(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "kit.yaml"
    code, _, _ = call(
        "export", SAMPLE, "--format", "autoware", "--out", out, "--camera", "left",
        "--lidar-frame", "velodyne_top", "--lidar-pose", "1 2 3 0 0 0.5",
    )  # fmt: skip
    assert code == 0
    kit = yaml.safe_load(out.read_text())["sensor_kit_base_link"]
    assert list(kit) == ["velodyne_top", "left/camera_link"]
    assert [kit["velodyne_top"][key] for key in ("x", "y", "z")] == [1, 2, 3]
