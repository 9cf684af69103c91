"""check: its exit codes, table and JSON."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import Audit, Dataset, load_rig
from calibgraph.audit import check
from calibgraph.audit.check import provenance
from tests.audit.deployed import motion, with_camera_moved
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call, CommandRun

REFERENCE = SAMPLE / "reference.yaml"
AXES = ("deviation_deg", "deviation_cm", "sigma_deg", "sigma_cm", "detectable_deg", "detectable_cm")


MEASURED: list[Audit] = []


def measure(rig: Path, data: Dataset, **options: Any) -> Audit:
    """Measure a right rig in one frame once, for the tests of all that is told about it."""
    if not MEASURED:
        MEASURED.append(check(rig, data, **options))
    same_recording, stated = provenance(rig, data)
    verdict = None if stated is None else stated.status
    return replace(MEASURED[0], same_recording=same_recording, deployed_verdict=verdict)


def test_a_right_rig_exits_with_0_and_the_json_names_its_units(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As six frames measure it; see the tests of the audit."""

    def six_frames(rig: Path, data: Dataset, **options: Any) -> Audit:
        audit, small = measure(rig, data, **options), np.full(6, 1e-3)
        of = {"status": "OK", "deviation": small, "sigma": small, "detectable": 3 * small}
        return replace(audit, cameras={n: replace(c, **of) for n, c in audit.cameras.items()})

    monkeypatch.setattr("calibgraph.check", six_frames)
    code, out, err = call("check", REFERENCE, SAMPLE, "--frames", "0", "--json")
    assert code == 0, err  # after 5 s, on a busy machine, err has a line of progress
    content = json.loads(out)
    assert set(content) == {
        "status", "wrong", "tolerance_deg", "tolerance_cm", "frames", "same_recording",
        "deployed_verdict", "cameras", "lidar", "lidars", "timings_s",
    }  # fmt: skip
    assert content["status"] == "OK"
    assert content["wrong"] == []
    assert content["lidar"] is None
    assert set(content["cameras"]) == {"front_left", "front_right", "left"}
    for camera in content["cameras"].values():
        assert set(camera) == {"status", "reason", "z_score", *AXES}
        assert all(len(camera[key]) == 3 for key in AXES)
        np.testing.assert_allclose(camera["deviation_deg"], np.degrees(1e-3))
        np.testing.assert_allclose(camera["detectable_cm"], 0.3)


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
    assert "WRONG  check: is the deployed calibration still right?" in lines  # behind progress
    assert any(line.startswith("  WRONG left: turned about y (yaw) by +") for line in lines)
    assert sum(line.startswith("  OK front_") for line in lines) == 2
    assert deployed.read_bytes() == before
    assert list(tmp_path.iterdir()) == [deployed]


def test_one_frame_exits_with_3_and_the_recording_that_made_the_result_is_named(
    call: Call, calibrated_sample: CommandRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibgraph.check", measure)
    code, _, err = call("check", calibrated_sample.folder, SAMPLE, "--frames", "0")
    assert code == 3
    assert err.splitlines()[0] == "CANNOT TELL  check: is the deployed calibration still right?"
    assert any(line.startswith("  It was made from this recording") for line in err.splitlines())
    assert "too few frames for an error bar of their own" in " ".join(err.split())
    _, out, _ = call("check", calibrated_sample.folder, SAMPLE, "--frames", "0", "--json")
    assert json.loads(out)["same_recording"] is True
    assert json.loads(out)["deployed_verdict"] == "PASS"


def test_a_malformed_result_is_refused_before_the_audit(
    call: Call, calibrated_sample: CommandRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = sys.modules[check.__module__]
    monkeypatch.setattr(module, "match_from_deployed", lambda *_, **__: pytest.fail("was measured"))
    text = (calibrated_sample.folder / "calibration.yaml").read_text()
    deployed = tmp_path / "calibration.yaml"
    deployed.write_text(re.sub(r"^verdict:\n(  .*\n)+", "verdict: PASS\n", text, flags=re.M))
    line = error_line(*call("check", deployed, SAMPLE, "--frames", "0"))
    assert f"{deployed}: verdict: " in line
