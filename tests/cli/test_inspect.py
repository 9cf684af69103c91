"""report, evaluate and perturb."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from calibgraph import MatcherErrors, Rig
from tests.cli.conftest import words_to_solve
from tests.conftest import Call


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


def test_report_writes_the_same_page_again(pair: Rig, call: Call, tmp_path: Path) -> None:
    nonsense, out = MatcherErrors(outlier_share=1.0), tmp_path / "out"
    code, _, err = call(*words_to_solve(tmp_path, pair, errors=nonsense))
    assert code == 1
    assert str(out / "report.html") in err.replace("\n", "")
    page = (out / "report.html").read_text()
    (out / "report.html").unlink()
    code, _, err = call("report", out)
    assert code == 0
    assert "the verdict is FAIL" in err
    assert (out / "report.html").read_text() == page  # the files hold everything on the page
    code, _, _ = call("report", out / "calibration.yaml", "--out", tmp_path / "other.html")
    assert code == 0
    assert (tmp_path / "other.html").read_text() == page
