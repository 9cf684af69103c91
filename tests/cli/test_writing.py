"""What a command may replace: its own folder, else nothing without --force."""

import shutil
from pathlib import Path

import pytest

from calibgraph import load_calibration, load_rig
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call, CommandRun


@pytest.fixture
def folder(solved: CommandRun, tmp_path: Path) -> Path:
    """A folder with rig.yaml, table.parquet, and a result in out."""
    return Path(shutil.copytree(solved.folder.parent, tmp_path / "copy"))


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_folder_of_a_result_is_written_again_and_other_files_stay(
    folder: Path, call: Call
) -> None:
    out = folder / "out"
    (out / "notes.txt").write_text("mine")
    (out / "calibration.yaml").write_text("of an earlier run")
    (out / "correspondences.parquet").unlink()
    inputs = (folder / "rig.yaml", folder / "table.parquet")
    assert call("solve", *inputs, "--out", out)[0] == 0
    assert (out / "notes.txt").read_text() == "mine"
    assert load_calibration(out).verdict.status == "PASS"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("solve rig.yaml table.parquet --out .", "holds files, but no calibration.yaml"),
        ("track rig.yaml table.parquet --out .", "holds files, but no calibration.yaml"),
        ("doctor {sample} --out .", "holds files, but no calibration.yaml"),
        ("pick {sample} --out .", "holds files, but no calibration.yaml"),
        ("fleet fleet.csv --out .", "holds files, but no calibration.yaml"),
        ("pick {sample} --out out --no-show", "reference.yaml: is of no session of pick"),
        ("simulate street --out .", "holds files, but no calibration.yaml"),
        ("calibrate {sample} --out rig.yaml", "is a file, expected a folder"),
        ("solve out table.parquet --out out", "is read by this command"),
        ("solve rig.yaml out/correspondences.parquet --out out", "is read by this command"),
        ("solve rig.yaml out --out out", "is read by this command"),
        ("track rig.yaml out --out out", "is read by this command"),
        ("calibrate {sample} --rig out --out out", "is read by this command"),
        ("match {sample} --out table.parquet", "is there already"),
        ("perturb rig.yaml --out rig.yaml", "is there already"),
        ("rig rig.yaml --out truth.yaml", "is there already"),
        ("export rig.yaml --format json --out truth.yaml", "is there already"),
        ("export rig.yaml --format camera_info --out infos", "is there already"),
        ("report out --out out/report.html", "is there already"),
        ("check rig.yaml {sample} --out out/report.html", "is there already"),
    ],
)
def test_what_is_read_or_not_the_commands_own_stays(
    line: str, said: str, folder: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "infos").mkdir()
    (folder / "out" / "reference.yaml").write_text("mine")
    (folder / "fleet.csv").write_text("vehicle,recording,rig\na,table.parquet,rig.yaml\n")
    (folder / "infos" / "left.yaml").write_text("mine")
    before = contents(folder)
    assert said in error_line(*call(*line.format(sample=SAMPLE).split()))
    assert contents(folder) == before


def test_a_table_that_the_result_beside_it_does_not_name_is_not_replaced(
    folder: Path, call: Call
) -> None:
    mine = shutil.copy(folder / "table.parquet", folder / "out" / "correspondences.parquet")
    inputs = (folder / "rig.yaml", folder / "table.parquet")
    message = error_line(*call("solve", *inputs, "--out", folder / "out"))
    assert f"{mine}: is not the table of a calibration.yaml beside it" in message
    assert "is not the table of" in error_line(*call("report", folder / "out"))
    assert load_rig(folder / "out").cameras  # the extrinsics can be used without the table


def test_force_replaces_a_file_but_no_result(folder: Path, call: Call) -> None:
    out = folder / "truth.yaml"
    assert call("perturb", folder / "rig.yaml", "--seed", 3, "--out", out, "--force")[0] == 0
    made = out.read_text()
    assert call("rig", folder / "rig.yaml", "--out", out, "--force")[0] == 0
    assert out.read_text() != made
    result = out.rename(out.with_name("calibration.yaml"))
    for words in (["perturb"], ["export", "--format", "json"]):
        found = call(words[0], result, *words[1:], "--out", result, "--force")
        assert "has the name of a result's main file" in error_line(*found)


@pytest.mark.usefixtures("no_image_checks")
def test_doctor_writes_its_findings_beside_its_pictures_again(call: Call, tmp_path: Path) -> None:
    for _ in range(2):
        assert call("doctor", SAMPLE, "--frames", "0", "--out", tmp_path / "seen")[0] == 0
    assert {path.name for path in (tmp_path / "seen").iterdir()} >= {
        "doctor.json", "guess_left.png",
    }  # fmt: skip
