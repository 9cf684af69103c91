"""Advice runs as printed: each line prints one in its situation, and what it says is then done."""

import json
import re
import shlex
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import calibgraph
from calibgraph import (
    CalibrationError,
    Diagnosis,
    Rig,
    export_calibration,
    simulate_correspondences,
)
from tests.cli.conftest import save_problem
from tests.conftest import KANNALA, SAMPLE, Call, make_camera, make_pair
from tests.draws.lenses import put_lens_error
from tests.io.bags.writing import Messages, Stamped, sample_messages, without, write_bag
from tests.io.formats.calibration_files import CAMERA_INFO, KALIBR, KOIDE, URDF, write

LINES = (Path(__file__).parent / "advice.txt").read_text().splitlines()
"""A command | what it prints, as a regular expression | what is then run: ``again`` stands for the
command, {0} for the first group of what is printed, and "FILE + TEXT" for the file with more lines.
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the lines name."""
    folder = save_problem(tmp_path_factory.mktemp("advice"))
    save_bags(folder)
    save_folders(folder)
    save_tables(folder)
    eye = URDF.replace("front_camera_optical_frame", "eye_optical").replace("front_link", "eye")
    two = URDF.replace("base_link", "lidar_mount")
    four = (
        CAMERA_INFO.replace("cols: 5", "cols: 4")
        .replace(", 0.003]", "]")
        .replace("distortion_model: plumb_bob\n", "")
    )
    spaced = CAMERA_INFO.replace("camera_name: front", "camera_name: front left")
    write(folder, four__yaml=four, spaced__yaml=spaced)
    write(folder, info__yaml=CAMERA_INFO, chain__yaml=KALIBR, car__urdf=URDF, eye__urdf=eye,
          two__urdf=two, calib__json=json.dumps(KOIDE))  # fmt: skip
    return folder


def save_bags(folder: Path) -> None:
    make = Messages("mcap")
    whole = sample_messages(make, calibgraph.load_dataset(SAMPLE, frames="0,1"))

    def save(name: str, messages: Iterable[Stamped]) -> None:
        write_bag(folder / "written", "mcap", messages).rename(folder / name)

    def moved(old: str, new: str) -> list[Stamped]:
        return [replace(each, topic=each.topic.replace(old, new)) for each in whole]

    save("bag", whole)
    save("two", [*whole, *(replace(e, topic="/rear") for e in whole if e.topic == "/points")])
    save("bare", without(whole, "/tf_static"))
    save("tf", (each for each in whole if each.topic == "/tf_static"))
    save("blind", (each for each in whole if "camera_info" not in each.topic))
    save("unnamed", moved("/left/image_raw", "/eye/image_raw"))
    infos = {each.topic: each for each in whole if each.topic.endswith("camera_info")}
    left, others = infos["/left/camera_info"], without(whole, "/left/camera_info")
    save("crossed", [*others, *(replace(left, topic=f"/left/{n}_info") for n in "ab")])
    save("shared", [*others, replace(infos["/front_left/camera_info"], topic=left.topic)])


def save_folders(folder: Path) -> None:
    calibgraph.load_rig(SAMPLE).save(folder / "sample.yaml")
    export_calibration(calibgraph.load_rig(SAMPLE), folder / "robot.urdf", "urdf")
    for drive in ("drive", "my drive"):
        for name in ("lidar", "cameras"):
            (folder / drive).mkdir(exist_ok=True)
            (folder / drive / name).symlink_to(SAMPLE / name)
    (folder / "drive" / "rig.yaml").write_text("mine: 1\n")
    save_drive(folder / "stamped", ["1700000000.0"], ["1700000000.1"])
    save_drive(folder / "lonely", "01", "1")
    save_drive(folder / "bins", "01", "01")
    for number, path in enumerate((folder / "bins" / "lidar").iterdir()):
        path.unlink()
        points = np.random.default_rng(number).normal(size=(101, 5)).astype("<f4")
        path.with_suffix(".bin").write_bytes(points.tobytes())
    rig = (folder / "sample.yaml").read_text()
    (folder / "unmarked.yaml").write_text(rig.partition("\n")[2])
    (folder / "pair" / "cameras").mkdir(parents=True)
    (folder / "pair" / "lidar").symlink_to(SAMPLE / "lidar")
    for name in ("left", "right"):
        (folder / "pair" / "cameras" / name).symlink_to(SAMPLE / "cameras" / f"front_{name}")
    (folder / "new").mkdir()


def save_drive(folder: Path, clouds: Sequence[str], images: Sequence[str]) -> None:
    """Frames of the sample, with these names."""
    (folder / "lidar").mkdir(parents=True)
    calibgraph.load_rig(SAMPLE).save(folder / "rig.yaml")
    for number, name in enumerate(clouds):
        shutil.copy(SAMPLE / "lidar" / f"00000{number}.npy", folder / "lidar" / f"{name}.npy")
    for camera in (SAMPLE / "cameras").iterdir():
        (folder / "cameras" / camera.name).mkdir(parents=True)
        for name in images:
            target = folder / "cameras" / camera.name / f"{name}.jpg"
            shutil.copy(camera / "000001.jpg", target)


def save_tables(folder: Path) -> None:
    table, rig = calibgraph.load_correspondences(folder / "table.parquet"), make_pair()
    replace(table, metadata={}).save(folder / "plain.csv")
    replace(table, confidence=table.confidence * 0.05).save(folder / "doubtful.parquet")
    lost = {**table.metadata, "missed": {"left": 3.0}}
    replace(table, metadata=lost).save(folder / "missed.parquet")
    twist = np.tile([0, 0, 0.1, 5, 0, 0], (len(table), 1))
    replace(table, twist_per_s=twist).save(folder / "moving.parquet")
    shared = {"systematic_rotation_rad": 0.1, "systematic_translation_m": 1.0}
    replace(table, metadata={**table.metadata, **shared}).save(folder / "shared.parquet")
    Rig(cameras={**rig.cameras, "third": make_camera()}).save(folder / "three.yaml")
    longer = put_lens_error(rig, "focal", 0.03)
    longer.save(folder / "long.yaml")
    Rig(cameras={"eye": make_camera(model="fisheye", distortion=KANNALA)}).save(
        folder / "wide.yaml"
    )
    turned = {"left": make_camera(), "right": make_camera(yaw_deg=80)}
    Rig(cameras=turned).save(folder / "turned.yaml")
    other = simulate_correspondences(rig, frames=8, matches=200, seed=1)
    for name, guess, given, of in (
        ("one", rig, table, "alignment"), ("mount", rig, other, "mount"),
        ("lens", longer, table, "alignment"),
        ("scatter", rig, replace(other, metadata={}), "alignment"),
    ):  # fmt: skip
        calibgraph.solve(guess, given, calibgraph.Config(of=of)).save(folder / name)


@pytest.fixture(autouse=True)
def _begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """What takes long ends where it would begin, with all that was given read."""

    def begin(*given: Any, **options: Any) -> None:
        raise CalibrationError("begun")

    for work in ("calibrate", "rounds.match_in_rounds", "pick.server.PickServer"):
        monkeypatch.setattr(f"calibgraph.{work}", begin)
    monkeypatch.setattr(import_module("calibgraph.audit.check"), "match_from_deployed", begin)
    monkeypatch.setattr("calibgraph.diagnose", lambda *_, **__: Diagnosis(()))


@pytest.mark.parametrize("line", [line for line in LINES if not line.startswith("#")])
def test_advice_runs_as_printed(
    line: str, files: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)

    def run(words: str) -> tuple[int, str]:
        given = shlex.split(words)
        for place, word in enumerate(given):
            if (parts := f" {word}".partition(" + "))[1]:
                text = Path(parts[0].strip()).read_text() if parts[0].strip() else ""
                Path("edited.yaml").write_text(f"{text}\n{parts[2]}\n".replace("; ", "\n"))
                given[place] = "edited.yaml"
        code, _, err = call(*given)
        return code, " ".join(err.split())

    command, printed, then = (part.strip() for part in line.split(" | "))
    _, text = run(command)
    found = re.search(printed, text)
    assert found, text
    code, after = run(then.replace("again", command).format(*found.groups()))
    assert code in (0, 1, 3) or after.endswith("calibgraph: begun"), after
    assert not re.search(printed, after)


@pytest.mark.parametrize("out", ["", "--out 'new/of my drive.yaml'"])
def test_the_commands_in_a_file_to_fill_in_run(
    out: str, files: Path, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(files)
    assert call("rig", "my drive", *shlex.split(out), "--force")[0] == 0
    written = Path(shlex.split(out)[1] if out else "my drive/rig.yaml")
    text = re.sub("\n# *", " ", written.read_text())
    assert f"then: calibgraph doctor 'my drive'{out.replace('--out', ' --rig')} Found" in text
    commands = re.findall(r'calibgraph (rig .*? --(?:lens|mount) ".*?")', text)
    assert len(commands) == 2
    for command in commands:
        assert call(*shlex.split(command.replace("NAME", "left")))[0] == 0
