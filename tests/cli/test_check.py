"""check: its exit codes, table and JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calibgraph import load_rig
from tests.audit.test_check import motion, with_camera_moved
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call

REFERENCE = SAMPLE / "reference.yaml"
AXES = ("deviation_deg", "deviation_cm", "sigma_deg", "sigma_cm", "detectable_deg", "detectable_cm")


def test_a_right_rig_exits_with_0_and_the_json_names_its_units(call: Call) -> None:
    code, out, err = call("check", REFERENCE, SAMPLE, "--json")
    assert (code, err) == (0, "")
    content = json.loads(out)
    assert set(content) == {
        "status", "wrong", "tolerance_deg", "tolerance_cm", "frames", "cameras", "lidar",
        "timings_s",
    }  # fmt: skip
    assert content["status"] == "OK"
    assert content["wrong"] == []
    assert content["lidar"] is None
    assert set(content["cameras"]) == {"front_left", "front_right", "left"}
    for camera in content["cameras"].values():
        assert set(camera) == {"status", "reason", "z_score", *AXES}
        assert all(len(camera[key]) == 3 for key in AXES)
        assert max(map(abs, camera["deviation_deg"])) < 0.1


@pytest.mark.slow
def test_a_turned_camera_exits_with_1_and_is_named_with_its_axis(
    call: Call, tmp_path: Path
) -> None:
    deployed = tmp_path / "deployed.yaml"
    with_camera_moved(load_rig(REFERENCE), "left", motion(1, degrees=1)).save(deployed)
    before = deployed.read_bytes()
    code, out, err = call("check", deployed, SAMPLE)
    assert (code, out) == (1, "")
    lines = err.splitlines()
    assert lines[0] == "WRONG"
    assert any(line.startswith("  WRONG left: turned about y (yaw) by +") for line in lines)
    assert sum(line.startswith("  OK front_") for line in lines) == 2
    assert deployed.read_bytes() == before
    assert list(tmp_path.iterdir()) == [deployed]


def test_one_frame_exits_with_3(call: Call) -> None:
    code, _, err = call("check", REFERENCE, SAMPLE, "--frames", "0")
    assert code == 3
    assert err.startswith("CANNOT TELL\n")
    assert "record" in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("missing.yaml", SAMPLE), "missing.yaml"),
        ((REFERENCE, "missing"), "missing"),
        ((REFERENCE, SAMPLE, "--tolerance-deg", "0"), "tolerance_deg must be positive"),
        ((REFERENCE, SAMPLE, "--tolerance-cm", "nan"), "tolerance_cm must be positive"),
    ],
)
def test_bad_input_is_one_line(call: Call, arguments: tuple[object, ...], words: str) -> None:
    assert words in error_line(*call("check", *arguments))
