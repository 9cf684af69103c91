"""The command line: what it prints and writes, its exit codes, and one line for bad input."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibgraph import (
    MatcherErrors,
    Rig,
    load_calibration,
    load_correspondences,
    load_rig,
    perturb,
    simulate_correspondences,
)
from calibgraph.cli import app
from tests.conftest import SAMPLE, Call, make_camera


@pytest.fixture
def problem(pair: Rig, tmp_path: Path) -> Path:
    """A folder with a rig, its truth, and a table of correspondences."""
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.15)
    simulate_correspondences(pair, frames=8, matches=200, errors=errors).save(
        tmp_path / "table.parquet"
    )
    pair.save(tmp_path / "truth.yaml")
    perturb(pair, rotation_deg=2, translation_m=0.2).save(tmp_path / "rig.yaml")
    return tmp_path


def one_line(code: int, out: str, err: str) -> str:
    """The message of bad input: exit code 2, nothing on stdout, one line on stderr."""
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("calibgraph: ")
    return err


def test_solve_then_evaluate(problem: Path, call: Call) -> None:
    out = problem / "result"
    code, stdout, stderr = call(
        "solve", problem / "rig.yaml", problem / "table.parquet", "--out", out
    )
    assert code == 0
    assert stdout == ""
    assert "PASS" in stderr
    assert "p_camera = T_camera_lidar * p_lidar" in stderr
    code, stdout, _ = call("evaluate", out, problem / "truth.yaml", "--json")
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
    _, _, table = call("evaluate", out / "calibration.yaml", problem / "truth.yaml")
    assert "left->right" in table


def test_the_result_file_is_complete_and_returns_the_result(problem: Path, call: Call) -> None:
    out = problem / "result"
    call("solve", problem / "rig.yaml", problem / "table.parquet", "--out", out, "--seed", 3)
    content = yaml.safe_load((out / "calibration.yaml").read_text())
    assert content["format"] == "calibgraph-calibration/1"
    assert content["frames"] == "p_camera = T_camera_lidar * p_lidar"
    assert content["config"]["seed"] == 3
    assert list(content["inputs"]) == [str(problem / "table.parquet")]
    assert {"gtsam", "numpy", "calibgraph"} <= set(content["versions"])
    result = load_calibration(out)
    assert result.verdict.status == "PASS"
    assert result.covariance["left"].shape == (6, 6)
    rig = load_rig(out)
    for name, T in result.T_camera_lidar.items():
        np.testing.assert_array_equal(rig.T_camera_lidar[name], T)


def test_json_is_on_stdout_and_whole(problem: Path, call: Call) -> None:
    code, stdout, stderr = call(
        "solve", problem / "rig.yaml", problem / "table.parquet",
        "--out", problem / "result", "--json",
    )  # fmt: skip
    assert code == 0
    assert stderr == ""
    summary = json.loads(stdout)
    assert summary["verdict"] == "PASS"
    assert np.array(summary["cameras"]["left"]["T_camera_lidar"]).shape == (4, 4)
    assert len(summary["cameras"]["left"]["rotation_sigma_deg"]) == 3


def test_a_failed_calibration_exits_1_and_its_file_says_so(problem: Path, call: Call) -> None:
    rig = load_rig(problem / "rig.yaml")
    nonsense = MatcherErrors(outlier_share=1.0)
    simulate_correspondences(rig, errors=nonsense).save(problem / "bad.parquet")
    out = problem / "result"
    code, _, stderr = call("solve", problem / "rig.yaml", problem / "bad.parquet", "--out", out)
    assert code == 1
    assert "FAIL" in stderr
    assert load_calibration(out).verdict.status == "FAIL"


def test_calibrate_from_a_table_writes_pictures(call: Call, tmp_path: Path) -> None:
    truth = load_rig(SAMPLE / "reference.yaml")
    simulate_correspondences(truth, frames=6).save(tmp_path / "table.csv")
    code, _, stderr = call(
        "calibrate", SAMPLE, "--matcher", tmp_path / "table.csv", "--out", tmp_path / "out"
    )
    assert code == 0, stderr
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        "calibration.yaml", "correspondences.parquet", "overlay_front_left.png",
        "overlay_front_right.png", "overlay_left.png", "report.html",
    }  # fmt: skip
    assert len(load_calibration(tmp_path / "out").inputs) == 6 * 4


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


def test_bad_rigs_and_tables_are_one_line(problem: Path, call: Call) -> None:
    rig, table = problem / "rig.yaml", problem / "table.parquet"
    (problem / "half.parquet").write_bytes(table.read_bytes()[:1000])
    (problem / "bad.yaml").write_text("format: calibgraph-rig/1\ncameras: {a: {fov: 3}}\n")
    (problem / "config.yaml").write_text("preset: kitti\nlambda: 3\n")
    (problem / "negative.yaml").write_text("gate_px: -1\n")
    cases: dict[str, tuple[object, ...]] = {
        "no such file": ("solve", problem / "nothing.yaml", table),
        "cannot be read as Parquet": ("solve", rig, problem / "half.parquet"),
        "unknown key": ("solve", problem / "bad.yaml", table),
        "unknown key 'lambda'": ("solve", rig, table, "--config", problem / "config.yaml"),
        "gate_px": ("solve", rig, table, "--config", problem / "negative.yaml"),
        "unknown preset 'best'": ("solve", rig, table, "--preset", "best"),
        "--terms 'all'": ("solve", rig, table, "--terms", "all"),
        "exclude each other": (
            "solve", rig, table, "--preset", "kitti", "--config", problem / "config.yaml",
        ),
        "not in the reference": ("evaluate", rig, SAMPLE / "reference.yaml"),
        "unknown matcher 'magic'": ("calibrate", SAMPLE, "--matcher", "magic"),
        "no such folder": ("calibrate", problem / "nothing"),
        "frames '9:'": ("calibrate", SAMPLE, "--frames", "9:"),
        "must end in": ("match", SAMPLE, "--out", problem / "table.txt"),
    }  # fmt: skip
    for message, arguments in cases.items():
        extra = () if arguments[0] in ("evaluate", "match") else ("--out", problem / "never")
        assert message in one_line(*call(*arguments, *extra))
    assert not (problem / "never").exists()


@pytest.mark.slow
def test_cameras_that_see_nothing_of_the_cloud_are_one_line(call: Call, tmp_path: Path) -> None:
    rig = load_rig(SAMPLE)
    backwards = np.diag([-1.0, 1.0, -1.0, 1.0]) @ rig.T_camera_lidar["front_left"]
    # Behind the rig the sample's LiDAR returns nothing at all.
    rig.moved_to({"front_left": backwards}).save(tmp_path / "rig.yaml")
    message = one_line(*call("calibrate", SAMPLE, "--rig", tmp_path / "rig.yaml",
                             "--out", tmp_path / "out"))  # fmt: skip
    assert "'front_left'" in message
    assert not (tmp_path / "out").exists()


def test_a_truncated_image_writes_nothing(call: Call, tmp_path: Path) -> None:
    sample = Path(shutil.copytree(SAMPLE, tmp_path / "sample"))
    broken = sample / "cameras" / "left" / "000005.jpg"
    broken.write_bytes(broken.read_bytes()[:9000])
    message = one_line(*call("calibrate", sample, "--out", tmp_path / "out"))
    assert "000005.jpg" in message
    assert "truncated" in message
    assert not (tmp_path / "out").exists()


def test_an_unwritable_folder_is_one_line(problem: Path, call: Call) -> None:
    (problem / "occupied").write_text("a file, not a folder")
    message = one_line(*call("solve", problem / "rig.yaml", problem / "table.parquet",
                             "--out", problem / "occupied"))  # fmt: skip
    assert "occupied" in message


@pytest.mark.parametrize(
    "arguments",
    [
        ("calibrate",),
        ("calibrate", SAMPLE, "--seed", -1),
        ("calibrate", SAMPLE, "--seed", 10**30),
        ("calibrate", SAMPLE, "--colour", "red"),
        ("guess", SAMPLE),
        ("perturb", SAMPLE, "--out", "never.yaml", "--translation-m", "inf"),
        ("perturb", SAMPLE, "--out", "never.yaml", "--rotation-deg", "nan"),
        ("perturb", SAMPLE, "--out", SAMPLE),
        ("perturb", SAMPLE, "--out", SAMPLE / "rig.yaml"),
        ("perturb", SAMPLE, "--out", SAMPLE / "reference.yaml"),
        ("perturb", SAMPLE, "--out", SAMPLE / "lidar" / "000000.npy"),
        ("report", SAMPLE, "--out", SAMPLE / "rig.yaml"),
        ("calibrate", SAMPLE, "--search-deg", "none", "--search-m", 1.5),
        ("calibrate", SAMPLE, "--out", SAMPLE / "rig.yaml"),
    ],
)
def test_wrong_options_are_one_line(arguments: tuple[object, ...], call: Call) -> None:
    one_line(*call(*arguments))


def test_ctrl_c_is_one_line(monkeypatch: pytest.MonkeyPatch, call: Call) -> None:
    def interrupted(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("calibgraph.io.rigs.load_rig", interrupted)
    code, out, err = call("perturb", SAMPLE, "--out", "never.yaml")
    assert (code, out, err) == (130, "", "calibgraph: interrupted\n")


def test_names_are_printed_as_they_are(tmp_path: Path, call: Call) -> None:
    rig = Rig(cameras={"[red]": make_camera(), "[bold]b": make_camera((0, 0.5, 0))})
    rig.save(tmp_path / "rig.yaml")
    simulate_correspondences(rig, frames=6).save(tmp_path / "table.parquet")
    code, _, stderr = call("solve", tmp_path / "rig.yaml", tmp_path / "table.parquet",
                           "--out", tmp_path / "out")  # fmt: skip
    assert code == 0
    assert "[red]" in stderr
    assert "[bold]b" in stderr


def test_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    missing = str(tmp_path / "nothing.yaml")
    monkeypatch.setattr(sys, "argv", ["calibgraph", "--debug", "evaluate", missing, missing])
    with pytest.raises(Exception, match="no such file"):
        app.main()


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; sys.argv = ['calibgraph', '--help']\n"
        "from calibgraph.cli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'gtsam', 'numpy', 'numba', 'cv2', 'scipy', 'pyarrow', 'pydantic', 'jinja2'}\n"
        "sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for command in ("calibrate", "match", "solve", "report", "evaluate", "perturb"):
        assert command in done.stdout


def test_it_runs_as_a_module_too() -> None:
    command = [sys.executable, "-m", "calibgraph", "evaluate", "nothing.yaml", "nothing.yaml"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("calibgraph: nothing.yaml") and done.stderr.count("\n") == 1


def test_one_camera_is_a_rig_too(tmp_path: Path, call: Call) -> None:
    rig = Rig(cameras={"only": make_camera()})
    rig.save(tmp_path / "rig.yaml")
    simulate_correspondences(rig, frames=6).save(tmp_path / "table.parquet")
    code, _, _ = call("solve", tmp_path / "rig.yaml", tmp_path / "table.parquet",
                      "--out", tmp_path / "out")  # fmt: skip
    assert code == 0
    code, stdout, _ = call("evaluate", tmp_path / "out", tmp_path / "rig.yaml", "--json")
    assert json.loads(stdout)["pairs"] == {}


def test_match_writes_a_table(call: Call, tmp_path: Path) -> None:
    truth = load_rig(SAMPLE / "reference.yaml")
    simulate_correspondences(truth, frames=6).save(tmp_path / "table.parquet")
    code, _, _ = call("match", SAMPLE, "--matcher", tmp_path / "table.parquet",
                      "--frames", "0:3", "--out", tmp_path / "part.csv")  # fmt: skip
    assert code == 0
    assert set(load_correspondences(tmp_path / "part.csv").frame.tolist()) == {0, 1, 2}
