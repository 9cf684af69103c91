"""No false PASS: a part of `benchmarks.accuracy.verdicts`, on cases that set no threshold."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT

OFF_DEG, OFF_CM = 0.5, 10.0
RIGHT_DEG, RIGHT_CM = 0.15, 4.0
TABLES = (
    "good,random,swapped,shuffled,focal_5,focal_3,principal,distorted,mirrored,wall,far_away,"
    "two_poses_60,few_frames,time_offset,units"
)


def cameras_of(tmp_path: Path, *options: object) -> list[dict[str, Any]]:
    """Run the benchmark: the verdict and the error of each camera's result, with its kind."""
    out = tmp_path / "cases.jsonl"
    module = "benchmarks.accuracy.verdicts"
    command = [sys.executable, "-m", module, "--set", "count", "--out", out, *options]
    subprocess.run(list(map(str, command)), cwd=ROOT, check=True, capture_output=True)
    cases = [json.loads(line) for line in out.read_text().splitlines()]
    assert not any("crash" in case for case in cases)
    return [{**one, "kind": c["kind"]} for c in cases for one in c.get("cameras", {}).values()]


def is_off(camera: dict[str, Any]) -> bool:
    return camera["error_deg"] > OFF_DEG or camera["error_cm"] > OFF_CM


@pytest.mark.statistics
def test_wrong_tables_do_not_pass_and_good_ones_do_not_fail(tmp_path: Path) -> None:
    cameras = cameras_of(tmp_path, "--tables", 4, "--kinds", TABLES)
    off = [camera for camera in cameras if is_off(camera)]
    assert len(off) > 60
    assert not [(c["kind"], c["error_deg"], c["error_cm"]) for c in off if c["status"] == "PASS"]
    good = [camera["status"] for camera in cameras if camera["kind"] == "good"]
    assert good and "FAIL" not in good and "PASS" in good


@pytest.mark.realdata
def test_good_recordings_do_not_fail(tmp_path: Path, realdata: Path) -> None:
    several = ("--data", 1, "--first", 2)  # 06, 07 and 08: one place alone may be off by more
    cameras = cameras_of(tmp_path, *several, "--kinds", "good", "--realdata", realdata)
    right = [
        camera["status"]
        for camera in cameras
        if camera["error_deg"] < RIGHT_DEG and camera["error_cm"] < RIGHT_CM
    ]
    assert right and "FAIL" not in right
    assert "PASS" not in [camera["status"] for camera in cameras if is_off(camera)]


@pytest.mark.realdata
@pytest.mark.parametrize("kind", ["swapped", "focal_5", "mirrored"])
def test_wrong_recordings_do_not_pass(kind: str, tmp_path: Path, realdata: Path) -> None:
    cameras = cameras_of(tmp_path, "--data", 1, "--kinds", kind, "--realdata", realdata)
    off = [camera for camera in cameras if is_off(camera)]
    assert off
    assert not [(c["error_deg"], c["error_cm"]) for c in off if c["status"] == "PASS"]
