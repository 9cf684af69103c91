"""From a bag without transforms, and no other file, to a launch file in three commands."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from calibgraph import evaluate, load_calibration, load_rig
from tests.conftest import SAMPLE, Call

MOUNTED = {"front_left": "front, 0.4 m ahead", "front_right": "front, 0.4 m ahead", "left": "left"}


@pytest.mark.slow
def test_a_bag_without_transforms(call: Call, tmp_path: Path) -> None:
    """The second command is as the first proposed it; frames are those of the bag."""
    from tests.io.bags.writing import Messages, sample_messages, without, write_bag

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
    for error in evaluate(load_calibration(out).rig, truth).cameras.values():
        assert error.rotation_error_deg < 0.12  # 1 px
        assert error.translation_error_cm < 3
