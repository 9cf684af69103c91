"""What the command line and the files show of a verdict."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

import calibgraph
from calibgraph import MatcherErrors, Rig, simulate_correspondences
from tests.conftest import SAMPLE, Call


@pytest.fixture
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


@pytest.mark.slow
def test_a_failure_marks_every_file_and_exits_1(call: Call, tmp_path: Path, truth: Rig) -> None:
    """Random correspondences: FAIL in the result, in the table, in the pictures, on the page."""
    nonsense = simulate_correspondences(truth, frames=6, errors=MatcherErrors(outlier_share=1.0))
    nonsense.save(tmp_path / "table.parquet")
    out = tmp_path / "out"
    code, _, text = call("calibrate", SAMPLE, "--matcher", tmp_path / "table.parquet", "--out", out)
    assert code == 1 and text.startswith("FAIL")
    assert yaml.safe_load((out / "calibration.yaml").read_text())["verdict"]["status"] == "FAIL"
    metadata = pq.read_schema(out / "correspondences.parquet").metadata
    assert any(b'"FAIL"' in value for value in metadata.values())
    assert "FAIL" in (out / "report.html").read_text().split("</title>")[0]
    calibgraph.load_calibration(out)


def test_the_error_bar_of_cameras_and_pairs_is_printed(
    call: Call, tmp_path: Path, pair: Rig
) -> None:
    pair.save(tmp_path / "rig.yaml")
    simulate_correspondences(pair, frames=8, matches=100).save(tmp_path / "table.parquet")
    command = (
        "solve", tmp_path / "rig.yaml", tmp_path / "table.parquet", "--out", tmp_path / "out",
        "--bootstrap", 5,
    )  # fmt: skip
    code, _, text = call(*command)
    assert code == 0
    for words in ("left->right", "left (bootstrap)", "weakest direction", "roll z"):
        assert words in text
    code, stdout, _ = call(*command, "--json")
    summary = yaml.safe_load(stdout)
    assert len(summary["pairs"]["left->right"]["translation_sigma_cm"]) == 3
    assert summary["cameras"]["left"]["weaknesses"]
    content = yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())
    assert "xi = (rotation [rad], translation [m])" in content["covariance_of"]
    assert "in the axes of B" in content["pair_covariance_of"]
    assert content["config"]["bootstrap"] == 5
