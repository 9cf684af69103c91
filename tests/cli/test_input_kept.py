"""No command removes or replaces what it reads, nor a file that it did not write."""

from __future__ import annotations

import inspect
import shutil
from pathlib import Path

import pytest

from calibgraph import (
    load_calibration,
    load_correspondences,
    load_rig,
    simulate_correspondences,
)
from calibgraph.cli.app import COMMANDS
from calibgraph.cli.fleet import fleet
from calibgraph.cli.guess import init
from calibgraph.cli.outputs import writes_of
from calibgraph.cli.simulate import simulate
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call, CommandRun, run_command


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of ``simulate``: correspondences.parquet, rig.yaml, reference.yaml."""
    folder = tmp_path_factory.mktemp("written") / "sim"
    run = run_command("simulate", "kitti", "--frames", 8, "--out", folder, folder=folder)
    assert run.code == 0
    return folder


@pytest.fixture(scope="module")
def solved(written: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of ``solve`` for that folder, to be copied."""
    out = tmp_path_factory.mktemp("solved") / "out"
    table = written / "correspondences.parquet"
    assert run_command("solve", written, table, "--out", out, folder=out).code == 0
    return out


@pytest.fixture
def simulated(tmp_path: Path, written: Path) -> Path:
    """A copy of that folder."""
    return Path(shutil.copytree(written, tmp_path / "sim"))


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
    assert "was not written by calibgraph" in message
    assert table.read_bytes() == other.read_bytes()


def test_the_result_that_is_the_guess_is_not_replaced(
    simulated: Path, solved: Path, call: Call
) -> None:
    table = simulated / "correspondences.parquet"
    out = shutil.copytree(solved, simulated / "out")
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
    assert f"{name}: was not written by calibgraph" in message
    assert (simulated / "out" / name).read_text() == "mine: 1\n"


def files_in(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_named_files_of_others_are_not_replaced(
    simulated: Path, calibrated_sample: CommandRun, call: Call
) -> None:
    result = Path(shutil.copytree(calibrated_sample.folder, simulated / "result"))
    for name in ("notes.html", "result/report.html", "notes.csv"):
        (simulated / name).write_text("mine")
    (simulated / "settings.yaml").write_text("preset: kitti\n")
    table = simulated / "table.parquet"
    load_correspondences(simulated / "correspondences.parquet").save(table)
    match = "match", SAMPLE, "--matcher", table, "--out"
    cases: list[tuple[str, tuple[object, ...]]] = [
        ("match", (*match, result / "correspondences.parquet")),
        ("match", (*match, simulated / "correspondences.parquet")),
        ("match", (*match, simulated / "notes.csv")),
        ("report", ("report", result)),
        ("report", ("report", result, "--out", simulated / "notes.html")),
        ("perturb", ("perturb", result, "--out", simulated / "rig.yaml")),
        ("perturb", ("perturb", simulated, "--out", result / "calibration.yaml")),
        ("export", ("export", simulated, "--format", "ros2", "--out", simulated / "notes.html")),
        ("import", ("import", simulated / "rig.yaml", "--out", simulated / "settings.yaml")),
    ]
    before = files_in(simulated)
    for command, arguments in cases:
        message = error_line(*call(*arguments))
        assert f"was not written by calibgraph {command}, and would be replaced" in message
    assert "is read by this command" in error_line(*call(*match, table))
    assert before == files_in(simulated)


def test_what_a_command_wrote_is_replaced_by_it_but_not_while_it_is_read(
    simulated: Path, call: Call
) -> None:
    table, found = simulated / "table.parquet", simulated / "found.parquet"
    truth = load_rig(SAMPLE / "reference.yaml")
    simulate_correspondences(truth, frames=6).save(table)
    guess = simulated / "guess.yaml"
    for arguments in (
        ("match", SAMPLE, "--matcher", table, "--out", found),
        ("perturb", simulated, "--out", guess),
    ):
        assert [call(*arguments)[0] for _ in range(2)] == [0, 0]
    for arguments in (
        ("match", SAMPLE, "--matcher", found, "--out", found),
        ("perturb", guess, "--out", guess),
        ("import", guess, "--out", guess),
        ("import", f"left={guess}", "--out", guess),
        ("export", guess, "--format", "ros2", "--out", guess),
    ):
        assert "is read by this command" in error_line(*call(*arguments))


def test_a_followed_folder_is_not_the_place_of_a_result(
    simulated: Path, solved: Path, call: Call
) -> None:
    source = simulated / "source"
    source.mkdir()
    shutil.copy(solved / "correspondences.parquet", source)  # a result's, which may be replaced
    before = files_in(source)
    message = error_line(*call("track", simulated, source, "--out", source))
    assert "is read by this command" in message
    assert before == files_in(source)


def test_an_argument_longer_than_a_name_is_no_file(tmp_path: Path, call: Call) -> None:
    frames = ",".join(["0", *["7"] * 500])
    message = error_line(*call("match", SAMPLE, "--frames", frames, "--out", tmp_path / "t.csv"))
    assert "expected start:stop:step or positions" in message


def test_every_command_with_an_output_declares_it() -> None:
    written = {"out", "rerun", "mcap", "plot", "page", "graph"}
    for command in COMMANDS:
        options = inspect.signature(command).parameters.keys()
        undeclared = (options & written) - writes_of(command).keys()
        refuses_itself = command in (simulate, fleet, init)  # any data, what is no row, any file
        assert bool(undeclared) == refuses_itself


def test_the_table_of_another_result_is_refused(simulated: Path, solved: Path, call: Call) -> None:
    table = simulated / "correspondences.parquet"
    out = shutil.copytree(solved, simulated / "out")
    assert len(load_calibration(out).correspondences)
    shutil.copy(table, out / "correspondences.parquet")
    assert "is not the table of" in error_line(*call("report", out))
    assert load_rig(out).cameras  # the extrinsics can be used without the table
