"""From a bag or a camchain, and no other file of ours, to a launch file in three commands."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from calibgraph import evaluate, load_calibration, load_rig
from calibgraph.model.geometry import relative_transform
from tests.conftest import SAMPLE, Call

TRUTH = load_rig(SAMPLE / "reference.yaml")
MOUNTED = {"front_left": "front, 0.4 m ahead", "front_right": "front, 0.4 m ahead", "left": "left"}


def calibrate_and_export(call: Call, data: Path, folder: Path, said: str) -> list[str]:
    """The second and the third command, the second as the first proposed it; frames published."""
    proposed = re.search(r"--search-deg \S+ --search-m \S+", said)
    assert proposed is not None
    rig, out, launch = folder / "rig.yaml", folder / "result", folder / "rig.launch.xml"
    assert call("calibrate", data, "--rig", rig, *proposed[0].split(), "--out", out)[0] == 0
    assert call("export", out, "--format", "ros2-launch", "--out", launch)[0] == 0
    nodes = ElementTree.parse(launch).getroot().iter("node")
    return [node.attrib["args"].split()[-1] for node in nodes]


def mounts(words: dict[str, str]) -> list[str]:
    return [part for name, text in words.items() for part in ("--mount", f"{name}={text}")]


@pytest.mark.slow
def test_a_bag_without_transforms(call: Call, tmp_path: Path) -> None:
    from tests.io.bags.writing import Messages, sample_messages, without, write_bag

    bag = write_bag(tmp_path, "mcap", without(sample_messages(Messages("mcap")), "/tf_static"))
    code, _, said = call("rig", bag, *mounts(MOUNTED), "--out", tmp_path / "rig.yaml")
    assert code == 0
    frames = calibrate_and_export(call, bag, tmp_path, said)
    assert frames == [f"{name}_optical" for name in MOUNTED]  # those of the bag
    for error in evaluate(load_calibration(tmp_path / "result").rig, TRUTH).cameras.values():
        assert error.rotation_error_deg < 0.12  # 1 px
        assert error.translation_error_cm < 3


@pytest.mark.slow
def test_a_camchain(call: Call, tmp_path: Path) -> None:
    names = dict(zip(TRUTH.cameras, ("cam0", "cam1", "cam2"), strict=True))
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(camchain()))
    data = tmp_path / "recording"
    (data / "cameras").mkdir(parents=True)
    (data / "lidar").symlink_to(SAMPLE / "lidar")
    for name, cam in names.items():
        (data / "cameras" / cam).symlink_to(SAMPLE / "cameras" / name)
    words = mounts({"cam0": "front, 0.4 m ahead"})
    camchain_file, rig = tmp_path / "camchain.yaml", tmp_path / "rig.yaml"
    code, _, said = call("rig", camchain_file, *words, "--out", rig)
    assert code == 0
    frames = calibrate_and_export(call, data, tmp_path, said)
    assert frames == [f"{name}_optical_frame" for name in names.values()]
    found = load_calibration(tmp_path / "result").T_camera_lidar
    moved = TRUTH.moved_to({name: found[cam] for name, cam in names.items()})
    for error in evaluate(moved, TRUTH).cameras.values():
        assert error.rotation_error_deg < 0.12
        assert error.translation_error_cm < 3


def camchain() -> dict[str, object]:
    """The truth's lenses and relative poses, as Kalibr writes them; its radtan has four terms."""
    content: dict[str, object] = {}
    before = None
    for index, (name, camera) in enumerate(TRUTH.cameras.items()):
        lens = camera.intrinsics_px
        content[f"cam{index}"] = {
            "camera_model": "pinhole",
            "intrinsics": [lens.fx, lens.fy, lens.cx, lens.cy],
            "distortion_model": "radtan",
            "distortion_coeffs": [*camera.distortion[:4], 0, 0, 0, 0][:4],
            "resolution": [camera.width_px, camera.height_px],
            "rostopic": f"/{name}/image_raw",
        }
        if before is not None:
            T = relative_transform(camera.T_camera_lidar, before).tolist()
            content[f"cam{index}"] |= {"T_cn_cnm1": T}  # type: ignore[operator]
        before = camera.T_camera_lidar
    return content
