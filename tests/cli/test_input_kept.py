"""No command removes or replaces what it reads, nor a file that it did not write."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from calibgraph import load_calibration, load_correspondences, load_rig
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call, CommandRun


@pytest.fixture
def simulated(tmp_path: Path, call: Call) -> Path:
    """A folder of ``simulate``: correspondences.parquet, rig.yaml, reference.yaml."""
    code, _, _ = call("simulate", "kitti", "--frames", 8, "--out", tmp_path / "sim")
    assert code == 0
    return tmp_path / "sim"


@pytest.mark.parametrize("command", ["track", "solve"])
def test_a_table_is_not_lost_in_the_folder_of_the_result(
    command: str, simulated: Path, call: Call
) -> None:
    table = simulated / "correspondences.parquet"
    before = table.read_bytes()
    message = error_line(*call(command, simulated, table, "--out", simulated))
    assert "is read by this command" in message
    assert table.read_bytes() == before


def test_a_table_that_is_only_beside_the_result_is_not_lost(simulated: Path, call: Call) -> None:
    table = simulated / "correspondences.parquet"
    other = Path(shutil.copy(table, simulated / "other.parquet"))
    message = error_line(*call("solve", simulated, other, "--out", simulated))
    assert "is not of an earlier result" in message
    assert table.read_bytes() == other.read_bytes()


def test_the_result_that_is_the_guess_is_not_replaced(simulated: Path, call: Call) -> None:
    table, out = simulated / "correspondences.parquet", simulated / "out"
    assert call("solve", simulated, table, "--out", out)[0] == 0
    assert "is read by this command" in error_line(*call("solve", out, table, "--out", out))
    assert call("solve", simulated, table, "--out", out)[0] == 0  # an earlier result is replaced


@pytest.mark.parametrize(
    "name", ["calibration.yaml", "report.html", "overlay_left.png", "track.png"]
)
def test_files_of_others_are_not_replaced(name: str, simulated: Path, call: Call) -> None:
    (simulated / "out").mkdir()
    (simulated / "out" / name).write_text("mine: 1\n")
    table = simulated / "correspondences.parquet"
    message = error_line(*call("solve", simulated, table, "--out", simulated / "out"))
    assert f"{name}: is not of an earlier result" in message
    assert (simulated / "out" / name).read_text() == "mine: 1\n"


def test_named_files_of_another_kind_are_not_replaced(
    simulated: Path, calibrated_sample: CommandRun, call: Call
) -> None:
    result = Path(shutil.copytree(calibrated_sample.folder, simulated / "result"))
    (simulated / "paper.png").write_text("mine")
    (simulated / "notes.html").write_text("<p>mine</p>")
    table = simulated / "table.parquet"
    load_correspondences(simulated / "correspondences.parquet").save(table)
    cases: dict[str, tuple[object, ...]] = {
        "is part of a result": (
            "match", SAMPLE, "--matcher", table, "--out", result / "correspondences.parquet",
        ),
        "is read by this command": ("match", SAMPLE, "--matcher", table, "--out", table),
        "is not a report": ("report", result, "--out", simulated / "notes.html"),
        "or no rig file": ("perturb", simulated, "--out", result / "calibration.yaml"),
        "paper.png: is not of a benchmark": ("bench", "paper", "kitti", "--out", simulated),
        "no file of settings": ("tune", "kitti", "--out", simulated / "rig.yaml"),
    }  # fmt: skip
    before = {path: path.read_bytes() for path in simulated.rglob("*") if path.is_file()}
    for message, arguments in cases.items():
        assert message in error_line(*call(*arguments))
    assert before == {path: path.read_bytes() for path in simulated.rglob("*") if path.is_file()}


def test_the_table_of_another_result_is_refused(simulated: Path, call: Call) -> None:
    table, out = simulated / "correspondences.parquet", simulated / "out"
    assert call("solve", simulated, table, "--out", out)[0] == 0
    assert len(load_calibration(out).correspondences)
    shutil.copy(table, out / "correspondences.parquet")
    assert "is not the table of" in error_line(*call("report", out))
    assert load_rig(out).cameras  # the extrinsics can be used without the table
