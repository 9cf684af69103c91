"""export: its options, and results that FAILed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from calibgraph import load_rig
from tests.conftest import SAMPLE, Call
from tests.io.formats.readers import READERS


def test_a_rig_is_exported_and_the_file_named(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "robot.urdf"
    code, stdout, err = call("export", SAMPLE, "--format", "urdf", "--out", out)
    assert (code, stdout, err) == (0, "", f"{out}: written (urdf)\n")
    truth = load_rig(SAMPLE).T_camera_lidar
    for name, T in READERS["urdf"](out).items():
        np.testing.assert_allclose(T, truth[name], atol=1e-9)


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
