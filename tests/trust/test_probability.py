"""From checks to the probability of an error; the table of thresholds; no false PASS."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import Config, Rig, load_calibration, solve
from calibgraph.model.verdict import (
    FAIL_ABOVE,
    PASS_BELOW,
    Check,
    ErrorProbability,
    Threshold,
    Verdict,
)
from calibgraph.trust.probability import (
    STRUCTURE,
    TABLES,
    judge,
    probability_beyond,
    probability_of_checks,
    probability_outside,
)
from calibgraph.trust.thresholds import THRESHOLDS, threshold
from tests.conftest import ROOT
from tests.trust.conftest import simulated

WIDE = np.diag([0.003, 0.002, 0.004, 0.03, 0.05, 0.02]) ** 2


@pytest.mark.parametrize("row", THRESHOLDS, ids=lambda row: row.key)
def test_a_row_grades_from_pass_to_fail_and_what_gets_worse_is_never_less_severe(
    row: Threshold,
) -> None:
    beyond = 1 if row.warn <= row.fail else -1
    assert row.fail != row.warn
    assert row.check(row.warn).status == "PASS"
    assert row.check(row.fail).status == "WARN"
    assert row.check(row.fail + beyond).status == ("WARN" if math.isinf(row.fail) else "FAIL")
    assert row.check(math.nan).status == row.grade(math.nan) == "FAIL"
    far = row.fail if math.isfinite(row.fail) else 10 * abs(row.warn) + 1
    values = np.linspace(row.warn - 2 * (far - row.warn), far + 2 * (far - row.warn), 401)
    severities = [row.check(value).severity for value in values]
    assert (np.diff(severities) >= -1e-12).all()
    assert row.check(row.warn).severity <= 1.0
    assert row.check(float(np.nextafter(row.warn, far))).severity >= 1.0
    assert max(severities) <= 3.0


@pytest.mark.parametrize("model", [TABLES, STRUCTURE])
@pytest.mark.parametrize("kind", [row.key for row in THRESHOLDS])
def test_a_worse_check_never_makes_a_result_more_probable(model: str, kind: str) -> None:
    def of(status: str, value: float) -> float:
        return probability_of_checks([Check(kind, status, "", value, 1.0, 2.0, kind=kind)], model)  # type: ignore[arg-type]

    found = [of("PASS", 0.0), of("PASS", 1.0), of("WARN", 2.0), of("FAIL", 4.0)]
    assert found == sorted(found)


@pytest.mark.parametrize("model", [TABLES, STRUCTURE])
def test_without_a_doubt_a_result_passes_and_a_check_nobody_has_seen_fails_it(model: str) -> None:
    assert judge([], 0.0, (0.5, 10.0), model).status == "PASS"
    new = Check("new", "FAIL", "", 3.5, 1.0, 2.0)
    assert judge([new], 0.0, (0.5, 10.0), model).status == "FAIL"
    not_found = judge([Check("search", "FAIL", "not found")], 0.0, (0.5, 10.0), model)
    assert not_found.error_probability.by_checks == 1


def test_several_doubts_are_worse_than_one_in_tables_and_as_the_worst_in_runs() -> None:
    one = [Check("first", "WARN", "")]
    four = [Check(f"doubt {k}", "WARN", "") for k in range(4)]
    of_tables, of_runs = (
        [probability_of_checks(checks, model) for checks in (one, four)]
        for model in (TABLES, STRUCTURE)
    )
    assert of_tables[1] > max(FAIL_ABOVE, 10 * of_tables[0])
    assert PASS_BELOW < of_runs[1] == of_runs[0] < FAIL_ABOVE


@pytest.mark.parametrize("model", [TABLES, STRUCTURE])
def test_a_known_check_just_beyond_its_limit_keeps_from_no_pass_and_an_unknown_one_does(
    model: str,
) -> None:
    known, new = (
        probability_of_checks([Check(kind, "WARN", "", 1.02, 1.0, 2.0)], model)
        for kind in ("relative_pose", "new")
    )
    assert known < PASS_BELOW <= new


def test_error_bars_of_runs_state_more_than_held_and_a_sure_one_is_sure() -> None:
    for stated in (0.01, 0.1, 0.9, 0.9999, 1.0):
        found = judge([], stated, (0.5, 10.0), STRUCTURE).error_probability
        assert found is not None and found.by_error_bar == stated
        assert found.probability == pytest.approx(stated, abs=1e-3) or (
            found.by_checks < found.probability < stated
        )
        by_tables = judge([], stated, (0.5, 10.0), TABLES).error_probability
        assert by_tables is not None and by_tables.probability == pytest.approx(stated, abs=1e-3)
    assert judge([], 0.9999, (0.5, 10.0), STRUCTURE).error_probability.probability > 0.99  # type: ignore[union-attr]


def test_a_wide_error_bar_and_few_frames_are_no_signs_of_an_error_in_runs() -> None:
    rows = {"sigma_translation": 60.0, "frames": 1.0}
    checks = [threshold(kind).check(value) for kind, value in rows.items()]
    assert {check.status for check in checks} > {"FAIL"}
    assert probability_of_checks(checks, STRUCTURE) == probability_of_checks([], STRUCTURE)
    wide = judge(checks, 0.9, (0.5, 10.0), STRUCTURE)
    assert (wide.status, wide.cannot_tell) == ("WARN", True)


def test_a_wide_error_bar_is_as_probably_off_as_draws_from_it() -> None:
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(6), WIDE, 200_000)
    turned = np.linalg.norm(draws[:, :3], axis=1) > np.radians(0.5)
    moved = np.linalg.norm(draws[:, 3:], axis=1) > 0.1
    expected = (turned | moved).mean()
    assert probability_beyond(WIDE, (0.5, 10.0)) == pytest.approx(expected, rel=0.02)
    assert probability_beyond(None, (0.5, 10.0)) == 0.0
    assert probability_beyond(WIDE, (5.0, 100.0)) < 1e-3
    assert judge([], expected, (0.5, 10.0), TABLES).status != "PASS"


@pytest.mark.parametrize("distance", [0.0, 0.5, 0.99, 1.5, 3.0])
def test_the_probability_outside_a_ball_is_the_share_of_draws_outside(distance: float) -> None:
    rng = np.random.default_rng(3)
    root = np.diag([0.2, 0.4, 0.8]) @ np.linalg.qr(rng.standard_normal((3, 3)))[0]
    mean, covariance = distance * np.array([0.6, 0.0, 0.8]), root @ root.T
    outside = np.linalg.norm(mean + rng.standard_normal((100_000, 3)) @ root.T, axis=1) > 1.0
    error = 4 * np.sqrt(0.25 / 100_000)  # of the draws; 400 directions add as much
    found = probability_outside(mean, covariance, 1.0)
    assert found == pytest.approx(outside.mean(), abs=2 * error)


def test_the_status_is_a_cut_of_the_probability() -> None:
    for probability, status in (
        (0.9 * PASS_BELOW, "PASS"), (PASS_BELOW, "WARN"), (FAIL_ABOVE, "WARN"),
        (1.01 * FAIL_ABOVE, "FAIL"), (math.nan, "FAIL"),
    ):  # fmt: skip
        assert Verdict((Check("x", "PASS", ""),), ErrorProbability(probability)).status == status
    assert (
        "off by more than 0.5 deg or 10 cm with a probability of 30%"
        in Verdict((), ErrorProbability(0.3)).reasons
    )


@pytest.mark.parametrize(
    ("check", "status"),
    [
        (Check("x", "WARN", "a reason", 1.1, 1.0, 2.0), "PASS"),
        (Check("frames", "WARN", "a reason", 4, 5, 2), "WARN"),  # the error bar is a default
        (Check("x", "FAIL", "a reason", 2.1, 1.0, 2.0), "WARN"),
    ],
)
def test_a_small_probability_is_a_pass_but_for_missing_data_or_a_failed_check(
    check: Check, status: str
) -> None:
    verdict = Verdict((check,), ErrorProbability(0.1 * PASS_BELOW))
    assert (verdict.status, verdict.reasons) == (status, ("a reason",))


def test_the_tolerance_is_a_setting_and_the_probability_is_kept(pair: Rig, tmp_path: Path) -> None:
    table = simulated(pair)
    usual = solve(pair, table)
    strict = solve(pair, table, Config(tolerance_deg=0.001, tolerance_cm=0.01))
    assert usual.verdict.status == "PASS"
    assert strict.verdict.status == "FAIL"  # over 99 %
    assert "off by more than 0.001 deg or 0.01 cm" in strict.verdict.reasons[0]
    strict.save(tmp_path / "out")
    assert load_calibration(tmp_path / "out").camera_verdicts == strict.camera_verdicts


OFF_DEG, OFF_CM = 0.5, 10.0
RIGHT_DEG, RIGHT_CM = 0.15, 4.0
KINDS = (
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
    cameras = cameras_of(tmp_path, "--tables", 4, "--kinds", KINDS)
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
