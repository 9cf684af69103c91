"""init: a rig file to fill in."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibgraph import load_rig, write_rig_template
from calibgraph.guessing.mounting import parse_mounting
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call

LENS = {"fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 179.5}


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """The sample without a rig."""
    folder = tmp_path / "drive"
    for name in ("lidar", "cameras"):
        shutil.copytree(SAMPLE / name, folder / name)
    return folder


def test_the_file_has_the_cameras_and_image_sizes_of_the_folder(
    recording: Path, call: Call
) -> None:
    code, out, err = call("init", recording)
    assert (code, out) == (0, "") and f"{recording / 'rig.yaml'}: written" in err
    cameras = yaml.safe_load((recording / "rig.yaml").read_text())["cameras"]
    assert list(cameras) == ["front_left", "front_right", "left"]
    assert {(c["width_px"], c["height_px"]) for c in cameras.values()} == {(640, 360)}


@pytest.mark.parametrize("command", ["calibrate", "match", "track"])
def test_an_unfilled_file_is_refused_with_the_key_that_is_left(
    recording: Path, call: Call, command: str
) -> None:
    write_rig_template(recording)
    rig = [recording / "rig.yaml"] if command == "track" else []
    line = error_line(*call(command, *rig, recording, "--out", recording.parent / "out.parquet"))
    assert "cameras.front_left.intrinsics_px.fx is still FILL_IN, and 17 more keys" in line


def test_doctor_names_the_key_that_is_left(recording: Path, call: Call) -> None:
    fill(write_rig_template(recording), leave="T_camera_lidar")
    code, _, err = call("doctor", recording)
    assert code == 1
    assert "cameras.front_left.T_camera_lidar is still FILL_IN, and 2 more keys" in err


def test_a_filled_file_is_a_rig_with_the_guess_of_the_words(recording: Path) -> None:
    words = {name: "front-left, 0.4 m ahead" for name in ("front_left", "front_right", "left")}
    path = write_rig_template(recording, mountings=words)
    fill(path, leave="")
    rig = load_rig(recording)
    assert rig.cameras["left"].matrix_px[0, 0] == LENS["fx"]
    wanted = parse_mounting("front-left, 0.4 m ahead", "left").T_camera_lidar()
    np.testing.assert_allclose(rig.T_camera_lidar["left"], wanted, atol=1e-6)  # as rounded


def test_matrices_in_the_comments_are_those_of_the_words(recording: Path) -> None:
    text = write_rig_template(recording).read_text()
    for words in ("front", "left", "right", "rear"):
        (line,) = (line for line in text.splitlines() if f"{words} " in line and "[[" in line)
        shown = yaml.safe_load(line[line.index("[[") :])
        wanted = parse_mounting(words, words).T_camera_lidar()
        np.testing.assert_allclose(shown, wanted, atol=1e-12)


def fill(path: Path, leave: str) -> None:
    """Fill in what a user would, but for a key."""
    content = yaml.safe_load(path.read_text())
    for camera in content["cameras"].values():
        camera |= {"intrinsics_px": LENS, "distortion": []}
        if leave != "T_camera_lidar" and camera["T_camera_lidar"] == "FILL_IN":
            camera["T_camera_lidar"] = np.eye(4).tolist()
    path.write_text(yaml.safe_dump(content))


def test_a_file_that_is_there_is_replaced_only_with_force(recording: Path, call: Call) -> None:
    mine = recording / "rig.yaml"
    mine.write_text("mine: 1\n")
    assert "is there already; --force replaces it" in error_line(*call("init", recording))
    assert mine.read_text() == "mine: 1\n"
    assert call("init", recording, "--force")[0] == 0
    assert mine.read_text().startswith("# Written by calibgraph init\n")


def test_folders_without_images_or_with_a_rig_of_their_own_are_one_line(
    tmp_path: Path, call: Call
) -> None:
    (tmp_path / "pictures").mkdir()
    assert "found are the folders pictures" in error_line(*call("init", tmp_path))
    (tmp_path / "calib.txt").write_text("")
    assert "brings its own rig" in error_line(*call("init", tmp_path))
    assert "no such folder" in error_line(*call("init", tmp_path / "nothing"))


def test_words_for_a_camera_that_is_not_there_are_refused(recording: Path, call: Call) -> None:
    line = error_line(*call("init", recording, "--mount", "rear=rear"))
    assert "--mount rear=...: no such camera; found are front_left, front_right, left" in line
    assert not (recording / "rig.yaml").exists()


@pytest.mark.parametrize(
    ("how", "focal_px"), [("90 deg", 320.0), ("53.13°", 640.0), ("4 mm 8 um", 500.0)]
)
def test_a_lens_in_words_is_computed_with_what_is_uncertain_of_it(
    recording: Path, call: Call, how: str, focal_px: float
) -> None:
    code, _, err = call("init", recording, "--lens", how, "--mount", "left=left",
                        "--mount", "front_left=front", "--mount", "front_right=front")  # fmt: skip
    assert code == 0
    assert f"next: calibgraph doctor {recording}" in err
    assert f"calibgraph calibrate {recording} --estimate lens" in err
    for camera in load_rig(recording).cameras.values():
        k, sigma = camera.intrinsics_px, camera.intrinsics_sigma_px
        assert k.fx == k.fy == pytest.approx(focal_px, abs=0.01)
        assert (k.cx, k.cy, camera.distortion) == (319.5, 179.5, ())
        assert sigma is not None and sigma.centre == 5.0
        assert sigma.focal == pytest.approx(0.02 * focal_px, abs=0.01)
        assert camera.distortion_sigma == 0.05


def test_a_lens_of_one_camera_is_named_and_the_others_are_filled_in(
    recording: Path, call: Call
) -> None:
    assert call("init", recording, "--lens", "left=90 deg")[0] == 0
    cameras = yaml.safe_load((recording / "rig.yaml").read_text())["cameras"]
    assert {n for n, c in cameras.items() if c["intrinsics_px"]["fx"] == "FILL_IN"} == {
        "front_left",
        "front_right",
    }


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("200 deg", "a field of view of 200 deg; of one over 150 deg the image is curved"),
        ("wide", "lens 'wide'; expected calibration; a horizontal field of view, as '90 deg'; or"),
        ("4 mm 0 um", "lens '4 mm 0 um'; expected"),
        ("rear=90 deg", "--lens rear=...: no such camera; found are front_left"),
    ],
)
def test_a_lens_that_is_not_understood_is_one_line(
    recording: Path, call: Call, how: str, message: str
) -> None:
    assert message in error_line(*call("init", recording, "--lens", how))
    assert not (recording / "rig.yaml").exists()


def test_in_a_terminal_init_asks_for_the_lens_of_each_camera(
    recording: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer of one camera is proposed for the next."""
    asked, answers = [], iter(("90 deg", "90 deg", "calibration"))

    def prompt(question: str, *, default: str, err: bool) -> str:
        assert err
        asked.append((question.partition(":")[0], default))
        return next(answers)

    monkeypatch.setattr("calibgraph.cli.guess._is_terminal", lambda: True)
    monkeypatch.setattr("typer.prompt", prompt)
    assert call("init", recording)[0] == 0
    assert asked == [
        ("front_left", "calibration"), ("front_right", "90 deg"), ("left", "90 deg")
    ]  # fmt: skip
    cameras = yaml.safe_load((recording / "rig.yaml").read_text())["cameras"]
    assert [c["intrinsics_px"]["fx"] for c in cameras.values()] == [320.0, 320.0, "FILL_IN"]
