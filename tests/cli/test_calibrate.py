"""calibrate, match, solve, report, evaluate, perturb: what they print and write; exit codes."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

from calibgraph import (
    MatcherErrors,
    Rig,
    load_calibration,
    load_correspondences,
    load_rig,
    simulate_correspondences,
)
from calibgraph.model.places import Places
from tests.cli.conftest import error_line, words_to_solve
from tests.conftest import SAMPLE, Call, CommandRun, make_camera, require_poses


def test_solve_then_evaluate(solved: CommandRun, call: Call) -> None:
    assert solved.code == 0
    assert solved.stdout == ""
    assert "PASS" in solved.stderr
    assert "p_camera = T_camera_lidar * p_lidar" in solved.stderr
    out, truth = solved.folder, solved.folder.parent / "truth.yaml"
    named = solved.stderr.partition("written:\n")[2].split()
    assert sorted(map(Path, named)) == sorted(out.iterdir())
    code, stdout, _ = call("evaluate", out, truth, "--json")
    assert code == 0
    errors = json.loads(stdout)
    keys = {
        "rotation_error_deg", "translation_error_cm", "x_cm", "y_cm", "z_cm",
        "roll_deg", "pitch_deg", "yaw_deg",
    }  # fmt: skip
    assert set(errors["cameras"]) == {"left", "right"}
    assert set(errors["pairs"]) == {"left->right"}
    for error in (*errors["cameras"].values(), *errors["pairs"].values()):
        assert set(error) == keys
        assert error["rotation_error_deg"] < 0.1
    _, _, table = call("evaluate", out / "calibration.yaml", truth)
    assert "left->right" in table


def test_a_prior_from_the_same_data_is_warned_of(
    solved: CommandRun, tmp_path: Path, call: Call
) -> None:
    """With an estimate of the lens: a guess alone is no prior. Also of a copy of the table."""
    problem, note = solved.folder.parent, "was made from the same data"
    table, kept = problem / "table.parquet", solved.folder / "correspondences.parquet"
    for rig, given, options, warned in (
        (solved.folder, table, ("--estimate", "focal"), True),
        (solved.folder, kept, ("--estimate", "focal"), True),
        (solved.folder, table, (), False),
        (problem / "rig.yaml", table, ("--estimate", "focal"), False),
    ):
        out = tmp_path / "again"
        _, _, err = call("solve", rig, given, *options, "--out", out)
        assert (note in err) == warned
        assert any(note in text for text in load_calibration(out).warnings) == warned


def test_the_result_file_is_complete_and_returns_the_result(solved: CommandRun) -> None:
    out = solved.folder
    content = yaml.safe_load((out / "calibration.yaml").read_text())
    assert content["format"] == "calibgraph-calibration/1"
    assert content["frames"] == "p_camera = T_camera_lidar * p_lidar"
    assert content["config"]["seed"] == 3
    assert list(content["inputs"]) == [str(out.parent / "table.parquet")]
    assert {"gtsam", "numpy", "calibgraph"} <= set(content["versions"])
    result = load_calibration(out)
    assert result.verdict.status == "PASS"
    assert result.covariance["left"].shape == (6, 6)
    rig = load_rig(out)
    require_poses(rig.T_camera_lidar, result.T_camera_lidar, atol=0)


def test_json_is_on_stdout_and_complete(problem: Path, call: Call) -> None:
    code, stdout, stderr = call(
        "solve", problem / "rig.yaml", problem / "table.parquet",
        "--out", problem / "result", "--json",
    )  # fmt: skip
    assert code == 0
    assert stderr == ""
    summary = json.loads(stdout)
    keys = {"verdict", "probability_off", "reasons", "cameras", "pairs", "timings_s", "files"}
    assert set(summary) == {*keys, "cannot_tell", "summary", "warnings", "places", "lidars"}
    assert summary["verdict"] == "PASS"
    assert summary["cannot_tell"] is False
    each = [camera["probability_off"] for camera in summary["cameras"].values()]
    assert 0 < summary["probability_off"] == max(each) < 0.005
    assert np.array(summary["cameras"]["left"]["T_camera_lidar"]).shape == (4, 4)
    assert len(summary["cameras"]["left"]["rotation_sigma_deg"]) == 3


def test_places_are_in_the_file_in_json_on_the_terminal_and_in_the_report(
    tmp_path: Path, pair: Rig, call: Call
) -> None:
    table = simulate_correspondences(pair, frames=8, matches=100)
    places = Places(places=((0, 1, 2, 5), (3, 4, 6, 7)))
    table.with_places(places).save(tmp_path / "table.parquet")
    pair.save(tmp_path / "rig.yaml")
    out = tmp_path / "result"
    arguments = "solve", tmp_path / "rig.yaml", tmp_path / "table.parquet", "--out", out
    _, _, text = call(*arguments)
    line = "2 places: frames 0-2, 5; 3-4, 6-7"
    assert line in text
    assert line in (out / "report.html").read_text("utf-8")
    assert load_calibration(out).places == places.places
    _, stdout, _ = call(*arguments, "--json")
    assert json.loads(stdout)["places"] == [[0, 1, 2, 5], [3, 4, 6, 7]]


def test_a_failed_calibration_exits_1_its_files_are_marked_and_its_page_is_written_again(
    pair: Rig, call: Call, tmp_path: Path
) -> None:
    out, nonsense = tmp_path / "out", MatcherErrors(outlier_share=1.0)
    code, _, stderr = call(*words_to_solve(tmp_path, pair, errors=nonsense))
    assert code == 1
    assert "FAIL" in stderr and str(out / "report.html") in stderr.replace("\n", "")
    result = load_calibration(out)
    assert result.verdict.status == "FAIL"
    assert [line.split()[1:] for line in stderr.splitlines() if line.startswith(" left->")] == [
        ["-"] * 6
    ]
    content = yaml.safe_load((out / "calibration.yaml").read_text())
    assert content["verdict"]["status"] == "FAIL"
    assert content["error_bar_holds"]["left->right"] is False
    metadata = pq.read_schema(out / "correspondences.parquet").metadata
    assert any(b'"FAIL"' in value for value in metadata.values())
    export = ("export", out, "--format", "json", "--out", tmp_path / "a.json")
    assert "is FAIL, nothing was written" in error_line(*call(*export))
    assert call(*export, "--even-if-failed")[0] == 0
    page = (out / "report.html").read_text()
    assert "FAIL" in page.split("</title>")[0]
    (out / "report.html").unlink()
    code, _, stderr = call("report", out)
    assert code == 0 and "the verdict is FAIL" in stderr
    assert (out / "report.html").read_text() == page  # the files hold everything on the page
    assert call("report", out / "calibration.yaml", "--out", tmp_path / "other.html")[0] == 0
    assert (tmp_path / "other.html").read_text() == page


def test_calibrate_writes_a_result_a_report_and_pictures(calibrated_sample: CommandRun) -> None:
    assert calibrated_sample.code == 0, calibrated_sample.stderr
    assert {path.name for path in calibrated_sample.folder.iterdir()} == {
        "calibration.yaml", "camera_matches.parquet", "correspondences.parquet",
        "overlay_front_left.png",
        "overlay_front_right.png", "overlay_left.png", "report.html",
    }  # fmt: skip
    assert len(load_calibration(calibrated_sample.folder).inputs) == 6 * 4


def test_names_are_printed_as_they_are(tmp_path: Path, call: Call) -> None:
    rig = Rig(cameras={"[red]": make_camera(), "[bold]b": make_camera((0, 0.5, 0))})
    code, _, stderr = call(*words_to_solve(tmp_path, rig, frames=6))
    assert code == 0
    assert "[red]" in stderr
    assert "[bold]b" in stderr


def test_match_writes_a_table(call: Call, tmp_path: Path) -> None:
    truth = load_rig(SAMPLE / "reference.yaml")
    simulate_correspondences(truth, frames=6).save(tmp_path / "table.parquet")
    code, _, _ = call("match", SAMPLE, "--matcher", tmp_path / "table.parquet",
                      "--frames", "0:3", "--out", tmp_path / "part.csv")  # fmt: skip
    assert code == 0
    assert set(load_correspondences(tmp_path / "part.csv").frame.tolist()) == {0, 1, 2}


def test_perturb_is_repeatable(problem: Path, call: Call) -> None:
    for name in ("one.yaml", "two.yaml"):
        code, _, _ = call(
            "perturb", problem / "truth.yaml", "--rotation-deg", 5, "--translation-m", 0.3,
            "--seed", 4, "--out", problem / name,
        )  # fmt: skip
        assert code == 0
    assert (problem / "one.yaml").read_text() == (problem / "two.yaml").read_text()
    code, stdout, _ = call("evaluate", problem / "one.yaml", problem / "truth.yaml", "--json")
    for error in json.loads(stdout)["cameras"].values():
        assert error["rotation_error_deg"] == pytest.approx(5)
