"""report, evaluate and perturb."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml

from calibgraph import Calibration, MatcherErrors, Rig, load_calibration, simulate_correspondences
from tests.conftest import SAMPLE, Call, CommandRun


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
    pair.save(tmp_path / "rig.yaml")
    nonsense = MatcherErrors(outlier_share=1.0)
    simulate_correspondences(pair, errors=nonsense).save(tmp_path / "table.parquet")
    out = tmp_path / "out"
    code, _, err = call("solve", tmp_path / "rig.yaml", tmp_path / "table.parquet", "--out", out)
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


def test_results_that_cannot_be_reported_are_one_line(
    pair: Rig, calibrated_sample: CommandRun, call: Call, tmp_path: Path
) -> None:
    sample = load_calibration(calibrated_sample.folder)
    sample.save(tmp_path / "sample")
    strange = Path(shutil.copytree(tmp_path / "sample", tmp_path / "strange"))
    simulate_correspondences(pair, frames=1).save(strange / "correspondences.parquet")
    cases: dict[str, tuple[object, ...]] = {
        "no such file": (tmp_path / "nothing",),
        "calibration.yaml: no such file": (SAMPLE,),
        "no such folder": (tmp_path / "sample", "--dataset", tmp_path / "nothing"),
        "is not the table of": (strange,),
        "it was edited": (edit(sample, tmp_path / "verdict"),),
        "its counts are not of the cameras": (edit(sample, tmp_path / "counts"),),
    }
    for message, arguments in cases.items():
        code, out, err = call("report", *arguments)
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert message in err
    assert not list(tmp_path.rglob("report.html"))


def edit(result: Calibration, folder: Path) -> Path:
    """Save a result and edit its file by hand; the folder's name is the key to change."""
    path = result.save(folder)
    content = yaml.safe_load(path.read_text())
    if folder.name == "verdict":
        content["verdict"]["status"] = "FAIL" if result.verdict.status == "PASS" else "PASS"
    else:
        content["counts"] = {"other": {"used": 1}}
    path.write_text(yaml.safe_dump(content))
    return folder
