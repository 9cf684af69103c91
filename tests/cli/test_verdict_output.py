"""What the command line and the files show of a verdict."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

import calibgraph
from calibgraph import MatcherErrors, Rig, simulate_correspondences
from tests.cli.conftest import words_to_solve
from tests.conftest import SAMPLE, Call


@pytest.mark.slow
def test_a_failure_marks_every_file_and_exits_1(call: Call, tmp_path: Path, truth: Rig) -> None:
    """Random correspondences: FAIL in the result, in the table, in the pictures, on the page."""
    nonsense = simulate_correspondences(truth, frames=6, errors=MatcherErrors(outlier_share=1.0))
    nonsense.save(tmp_path / "table.parquet")
    out = tmp_path / "out"
    code, _, text = call("calibrate", SAMPLE, "--matcher", tmp_path / "table.parquet", "--out", out)
    assert code == 1 and "\nFAIL: off by" in "\n" + text  # on a slow machine, progress before
    assert yaml.safe_load((out / "calibration.yaml").read_text())["verdict"]["status"] == "FAIL"
    metadata = pq.read_schema(out / "correspondences.parquet").metadata
    assert any(b'"FAIL"' in value for value in metadata.values())
    assert "FAIL" in (out / "report.html").read_text().split("</title>")[0]
    calibgraph.load_calibration(out)


def test_the_error_bar_of_cameras_and_pairs_is_printed(
    call: Call, tmp_path: Path, pair: Rig
) -> None:
    (tmp_path / "config.yaml").write_text("seed: 5\n")
    solve = words_to_solve(tmp_path, pair, frames=8, matches=100)
    command = (*solve, "--config", tmp_path / "config.yaml")
    code, _, text = call(*command)
    assert code == 0
    for words in ("left->right", "Least certain: ", "would help most"):
        assert words in text
    assert "more findings: see report.html" in text  # the weakest directions
    code, stdout, _ = call(*command, "--json")
    summary = yaml.safe_load(stdout)
    assert len(summary["pairs"]["left->right"]["translation_sigma_cm"]) == 3
    assert summary["cameras"]["left"]["weaknesses"]
    content = yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())
    assert "xi = (rotation [rad], translation [m])" in content["covariance_of"]
    assert "in the axes of B" in content["pair_covariance_of"]
    assert content["config"]["seed"] == 5


def test_a_warning_for_lack_of_data_is_told_from_one_that_looks_odd(
    call: Call, tmp_path: Path, pair: Rig
) -> None:
    """In the terminal, in JSON, in the file and on the page; the exit code is that of a WARN."""
    command, out = words_to_solve(tmp_path, pair, frames=3, matches=60), tmp_path / "out"
    code, _, text = call(*command)
    assert code == 0
    lines = text.splitlines()
    assert lines[0] == "WARN" or lines[0].startswith("WARN: off by more than 0.5 deg or 10 cm")
    assert lines[1].startswith("  WARN  left, right: cannot tell: ")
    assert "What to do:" in lines and "?" not in text and "CANNOT TELL" not in text
    summary = yaml.safe_load(call(*command, "--json")[1])
    assert summary["verdict"] == "WARN"
    assert summary["cannot_tell"] is True
    assert {camera["cannot_tell"] for camera in summary["cameras"].values()} == {True}
    assert summary["summary"]["reasons"][0]["text"].startswith("cannot tell: ")
    assert summary["summary"]["actions"] and summary["cameras"]["left"]["actions"]
    page = (out / "report.html").read_text()
    assert "<title>WARN" in page and "cannot tell: " in page and "CANNOT TELL" not in page
    content = yaml.safe_load((out / "calibration.yaml").read_text())
    assert content["verdict"]["status"] == "WARN"
    assert content["verdict"]["cannot_tell"] is True
    assert content["summary"] == summary["summary"]
    assert content["camera_verdicts"]["left"]["cannot_tell"] is True


def test_a_fail_shows_three_reasons_and_what_to_do_and_folds_the_rest(
    call: Call, tmp_path: Path, pair: Rig
) -> None:
    nonsense = MatcherErrors(outlier_share=1.0)
    code, _, text = call(*words_to_solve(tmp_path, pair, errors=nonsense))
    assert code == 1
    before = text[: text.index("Calibration")].splitlines()
    assert before[0].startswith("FAIL: off by more than 0.5 deg or 10 cm with a probability")
    at = before.index("What to do:")
    assert 1 <= len(before[1:at]) <= 3 and before[1].startswith("  FAIL  ")
    assert all(line.startswith(("  FAIL  ", "  WARN  ")) for line in before[1:at])
    folded = next(n for n, line in enumerate(before) if " more findings: see report.html" in line)
    assert 1 <= len([line for line in before[at + 1 : folded] if line.startswith("  ")]) <= 3


def test_the_common_error_of_a_table_without_one_is_an_option(
    call: Call, tmp_path: Path, pair: Rig
) -> None:
    pair.save(tmp_path / "rig.yaml")
    simulate_correspondences(pair, frames=8, matches=100).save(tmp_path / "table.csv")
    command = ("solve", tmp_path / "rig.yaml", tmp_path / "table.csv", "--out", tmp_path / "out")
    assert "cannot tell: scatter only: " in call(*command)[2]
    code, _, text = call(*command, "--common-deg", 0.05, "--common-cm", 1)
    assert code == 0 and text.startswith("PASS\n")
    assert "Least certain: " in text


def test_the_sources_of_an_error_bar_are_kept_in_the_file(tmp_path: Path, pair: Rig) -> None:
    result = calibgraph.solve(pair, simulate_correspondences(pair, frames=8, matches=100))
    result.save(tmp_path)
    assert calibgraph.load_calibration(tmp_path).error_sources == result.error_sources
    assert result.error_sources.keys() == set(pair.cameras)
