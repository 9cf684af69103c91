"""export and import."""

from __future__ import annotations

import inspect
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from calibgraph import MatcherErrors, export_calibration, load_rig, simulate_correspondences, solve
from calibgraph.cli.exchange import import_, parse_names
from calibgraph.io.formats.names import EXPORT_FORMATS
from calibgraph.io.formats.rig_import import RELATIVE_SIGMA_CM, RELATIVE_SIGMA_DEG
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call, make_pair
from tests.io.formats.calibration_files import (
    CAMERA_INFO,
    KALIBR,
    KOIDE,
    SENSOR_KIT,
    SENTENCE,
    URDF,
    write,
)
from tests.io.formats.readers import READERS


def test_a_rig_is_exported_and_the_file_named(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "robot.urdf"
    code, stdout, err = call("export", SAMPLE, "--format", "urdf", "--out", out)
    assert (code, stdout, err) == (0, "", f"{out}: written (urdf)\n")
    truth = load_rig(SAMPLE).T_camera_lidar
    for name, T in READERS["urdf"](out).items():
        np.testing.assert_allclose(T, truth[name], atol=1e-9)


def test_the_formats_are_listed_without_other_arguments(call: Call) -> None:
    code, stdout, err = call("export", "--format", "list")
    assert (code, err) == (0, "")
    assert [line.split()[0] for line in stdout.splitlines()] == list(EXPORT_FORMATS)


def test_options_of_export_reach_the_file(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "kit.yaml"
    code, _, _ = call(
        "export", SAMPLE, "--format", "autoware", "--out", out, "--camera", "left",
        "--lidar-frame", "velodyne_top", "--lidar-pose", "1 2 3 0 0 0.5",
    )  # fmt: skip
    assert code == 0
    kit = yaml.safe_load(out.read_text())["sensor_kit_base_link"]
    assert list(kit) == ["velodyne_top", "left/camera_link"]
    assert [kit["velodyne_top"][key] for key in ("x", "y", "z")] == [1, 2, 3]


def test_a_failed_result_needs_the_flag(call: Call, tmp_path: Path) -> None:
    nonsense = MatcherErrors(outlier_share=1.0)
    solve(make_pair(), simulate_correspondences(make_pair(), errors=nonsense)).save(tmp_path)
    arguments = ("export", tmp_path, "--format", "json", "--out", tmp_path / "a.json")
    assert "is FAIL, nothing was written" in error_line(*call(*arguments))
    assert not (tmp_path / "a.json").exists()
    code, _, _ = call(*arguments, "--even-if-failed")
    assert code == 0
    assert json.loads((tmp_path / "a.json").read_text())["verdict"] == "FAIL"


def test_wrong_exports_are_one_line(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "never"
    cases: dict[str, tuple[object, ...]] = {
        "format 'ros'": ("--format", "ros"),
        "camera 'rear'": ("--format", "tf2", "--camera", "rear"),
        "--lidar-pose '1 2'": ("--format", "autoware", "--lidar-pose", "1 2"),
        "autoware only": ("--format", "tf2", "--lidar-pose", "0 0 0 0 0 0"),
        "not finite": ("--format", "autoware", "--lidar-pose", "0 0 nan 0 0 0"),
        "two are the same": ("--format", "tf2", "--camera-frame", "camera"),
    }
    for said, arguments in cases.items():
        assert said in error_line(*call("export", SAMPLE, "--out", out, *arguments))
        assert not out.exists()
    assert "no such file" in error_line(
        *call("export", tmp_path / "nothing", "--format", "tf2", "--out", out)
    )
    rig = SAMPLE / "rig.yaml"
    message = error_line(*call("export", rig, "--format", "tf2", "--out", rig))
    assert "would replace it" in message


def test_import_prints_a_sentence_per_camera_and_writes_a_rig(call: Call, tmp_path: Path) -> None:
    info, car = write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=URDF)
    code, stdout, err = call("import", info, car, "--out", tmp_path / "rig.yaml")
    assert (code, stdout) == (0, "")
    assert err.splitlines()[0] == SENTENCE
    assert err.splitlines()[-1].startswith(f"{tmp_path / 'rig.yaml'}: 1 camera; check")
    assert list(load_rig(tmp_path / "rig.yaml").cameras) == ["front"]


def test_options_of_import_reach_the_rig(call: Call, tmp_path: Path) -> None:
    info, car = write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=URDF)
    code, _, err = call(
        "import", f"nose={info}", car, "--camera-frame", "nose=front_link", "--lidar-frame",
        "base_link", "--out", tmp_path / "rig.yaml",
    )  # fmt: skip
    assert code == 0, err
    assert err.startswith("nose looks along LiDAR +x, sits 1.40 m ahead, 0.10 m left and 1.80 m")
    (tmp_path / "calib.json").write_text(json.dumps(KOIDE))
    code, _, err = call(
        "import", f"front={tmp_path / 'calib.json'}", "--size", "1646x1240", "--out",
        tmp_path / "koide.yaml",
    )  # fmt: skip
    assert code == 0, err
    assert load_rig(tmp_path / "koide.yaml").cameras["front"].width_px == 1646


def test_cameras_of_a_camchain_are_renamed_everywhere(call: Call, tmp_path: Path) -> None:
    (chain,) = write(tmp_path, chain__yaml=KALIBR)
    code, _, err = call(
        "import", chain, "--rename", "cam0=left", "--rename", "cam1=right", "--out",
        tmp_path / "rig.yaml",
    )  # fmt: skip
    assert code == 0, err
    rig = load_rig(tmp_path / "rig.yaml")
    assert list(rig.cameras) == ["left", "right"]
    assert [(pair.a, pair.b) for pair in rig.relative_poses] == [("right", "left")]


def test_wrong_imports_are_one_line(call: Call, tmp_path: Path) -> None:
    info, chain = write(tmp_path, info__yaml=CAMERA_INFO, chain__yaml=KALIBR)
    out = tmp_path / "rig.yaml"
    cases: dict[str, tuple[object, ...]] = {
        "no file has its T_camera_lidar": (info, "--out", out),
        "--size '9': give WIDTHxHEIGHT": (chain, "--size", "9", "--out", out),
        "--camera-frame 'a': give two names": (chain, "--camera-frame", "a", "--out", out),
        "no camera 'front' to rename": (chain, "--rename", "front=a", "--out", out),
        "two cameras one name": (chain, "--rename", "cam0=cam1", "--out", out),
        "is read by this command": (chain, "--out", chain),
        "no such file": (tmp_path / "nothing.yaml", "--out", out),
        "must end in .yaml": (chain, "--out", tmp_path / "rig.txt"),
    }
    for said, arguments in cases.items():
        assert said in error_line(*call("import", *arguments))
    assert not out.exists()
    assert chain.read_text() == KALIBR


def test_a_camchain_becomes_a_rig_that_evaluate_takes(call: Call, tmp_path: Path) -> None:
    export_calibration(make_pair(), tmp_path / "chain.yaml", "kalibr")
    make_pair().save(tmp_path / "truth.yaml")
    code, _, _ = call("import", tmp_path / "chain.yaml", "--out", tmp_path / "rig.yaml")
    assert code == 0
    code, stdout, _ = call("evaluate", tmp_path / "rig.yaml", tmp_path / "truth.yaml", "--json")
    assert code == 0
    for error in json.loads(stdout)["cameras"].values():
        assert error["rotation_error_deg"] < 1e-7 and error["translation_error_cm"] < 1e-7


def test_defaults_on_the_command_line_are_the_librarys() -> None:
    """They are written twice, so that --help imports nothing heavy."""
    of_import = inspect.signature(import_).parameters
    assert of_import["tie_deg"].default == RELATIVE_SIGMA_DEG
    assert of_import["tie_m"].default == RELATIVE_SIGMA_CM / 100


def test_a_name_that_is_given_twice_is_refused() -> None:
    with pytest.raises(ValueError, match="--mount cam0=...: given 2 times; give it once"):
        parse_names("--mount", ["cam0=front", "cam1=left", "cam0=rear"])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('rpy="0 0 0"', 'rpy="0 0 90"'),
        ('rpy="-1.5707963267948966 0 -1.5707963267948966"', 'rpy="-90 0 -90"'),
        ('rpy="0 0 0"', 'rpy="0 -45.5 0"'),
    ],
)
def test_degrees_in_a_urdf_are_asked(call: Call, tmp_path: Path, old: str, new: str) -> None:
    assert old in URDF
    info, car = write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=URDF.replace(old, new))
    message = error_line(*call("import", info, car, "--out", tmp_path / "rig.yaml"))
    assert "beyond 2 pi: are they in degrees?" in message
    assert not (tmp_path / "rig.yaml").exists()


def test_degrees_in_a_sensor_kit_and_in_lidar_pose_are_asked(call: Call, tmp_path: Path) -> None:
    kit = SENSOR_KIT.replace("z: 0.8, roll: 0.0, pitch: 0.0, yaw: 0.0", "z: 0.8, roll: 0.0, pitch: "
                             "0.0, yaw: 90.0")  # fmt: skip
    info, path = write(tmp_path, info__yaml=CAMERA_INFO, kit__yaml=kit)
    message = error_line(*call("import", info, path, "--out", tmp_path / "rig.yaml"))
    assert "velodyne_top_base_link: roll, pitch, yaw are 0, 0, 90 rad" in message
    arguments = ("--format", "autoware", "--lidar-pose", "0 0 2 0 0 90")
    message = error_line(*call("export", SAMPLE, "--out", tmp_path / "out.yaml", *arguments))
    assert "--lidar-pose '0 0 2 0 0 90': roll, pitch, yaw are 0, 0, 90 rad" in message
    assert not (tmp_path / "out.yaml").exists()


def test_angles_of_a_turn_are_radians(call: Call, tmp_path: Path) -> None:
    turned = URDF.replace('rpy="0 0 0"', 'rpy="0 0 6.2832"')
    info, car = write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=turned)
    assert call("import", info, car, "--out", tmp_path / "rig.yaml")[0] == 0


def test_millimetres_are_warned_of_by_import_and_export(call: Call, tmp_path: Path) -> None:
    far = URDF.replace('xyz="1.4 0.1 1.8"', 'xyz="400 100 -200"')
    info, car = write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=far)
    said = "warning: front: the camera is 458 m from the LiDAR: lengths in millimetres"
    code, _, err = call("import", info, car, "--out", tmp_path / "rig.yaml")
    assert (code, err.count(said)) == (0, 1)
    pose = ("--lidar-pose", "0 0 1800 0 0 0")
    code, _, err = call("export", tmp_path / "rig.yaml", "--format", "autoware", "--out",
                        tmp_path / "kit.yaml", *pose)  # fmt: skip
    assert (code, err.count(said)) == (0, 1)
    assert "warning: --lidar-pose '0 0 1800 0 0 0': lengths in millimetres?" in err


def test_import_and_guess_note_what_they_assume(call: Call, tmp_path: Path) -> None:
    info = CAMERA_INFO.replace("distortion_model: plumb_bob\n", "").replace(
        "cols: 5, data: [-0.1, 0.02, 0.001, -0.002, 0.003]", "cols: 4, data: [-0.1, 0.02, 0.01, 0]"
    )
    path, car = write(tmp_path, info__yaml=info, car__urdf=URDF)
    for command in ("import", "guess"):
        code, _, err = call(command, path, car, "--out", tmp_path / f"{command}.yaml")
        assert code == 0, err
        assert err.splitlines()[0].startswith(f"note: {path}: distortion_coefficients has four")
