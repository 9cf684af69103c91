"""Files of other programs become a rig: ``forms.yaml`` has them, with what is expected of each."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibgraph import (
    Calibration,
    CalibrationError,
    FileError,
    Rig,
    describe_rig,
    import_rig,
    load_rig,
)
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.model.geometry import transform
from calibgraph.model.rig import KNOWLEDGE, IntrinsicsSigma
from tests.conftest import RADTAN5, make_camera, require_poses, stereo_relative_pose
from tests.io.formats.calibration_files import FRONT
from tests.io.formats.conftest import varied_rig
from tests.io.written import written_kitti

FORMS = yaml.safe_load((Path(__file__).parent / "forms.yaml").read_text())
CASES, TEXTS = FORMS["cases"], FORMS["texts"]
P_LIDAR = [10.4, -0.9, -2.2, 1.0]
SIZE = (1646, 1240)  # of images whose file has none


def text_of(name: str, content: Any) -> str:
    """The text of a file: as it is, one document, or several."""
    if isinstance(content, str):
        return content
    if name.endswith(".json"):
        return json.dumps(content)
    first = "%YAML:1.0\n---\n" if name.endswith(".yml") else ""
    each = content if isinstance(content, list) else [content]
    return first + "---\n".join(yaml.safe_dump(one, sort_keys=False) for one in each)


def saved(files: dict[str, Any], folder: Path) -> list[Path]:
    for name, content in files.items():
        (folder / name).write_text(text_of(name, content))
    return [folder / name for name in files]


def options_of(case: dict[str, Any], folder: Path) -> dict[str, Any]:
    options = case.get("options", {})
    names = {folder / name: camera for name, camera in options.get("names", {}).items()}
    return {**options, **({"names": names} if names else {})}


@pytest.mark.parametrize("name", CASES)
def test_lenses_worked_points_and_notes_are_those_expected(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    parts = read_rig_parts(saved(case["files"], tmp_path), **options_of(case, tmp_path))
    rig = parts.to_rig(size_px=SIZE)
    for camera, point in case.get("sees", {}).items():
        np.testing.assert_allclose((rig.T_camera_lidar[camera] @ P_LIDAR)[:3], point, atol=1e-6)
    for camera, (model, *numbers) in case.get("lens", {}).items():
        found = rig.cameras[camera]
        focal = found.intrinsics_px.model_dump().values()
        assert [*focal, found.width_px, found.height_px, *found.distortion] == numbers
        assert found.model == model
    pairs = {f"{pair.a} {pair.b}": pair.T_a_b for pair in rig.relative_poses}
    expected = case.get("pairs", {})
    assert pairs.keys() == expected.keys()
    for cameras, point in expected.items():
        seen = pairs[cameras] @ rig.T_camera_lidar[cameras.split()[1]] @ P_LIDAR
        np.testing.assert_allclose(seen[:3], point, atol=1e-12)
    notes = case.get("notes", [])
    assert all(note in found for note, found in zip(notes, parts.notes, strict=True))


@pytest.mark.parametrize("row", FORMS["broken"], ids=lambda row: row[-1])
def test_a_broken_file_is_one_line(row: list[Any], tmp_path: Path) -> None:
    first, *change, said = row
    options: dict[str, Any] = {}
    files = first
    if change:
        name, old, new = change
        files = dict(CASES[first]["files"])
        text = text_of(name, files[name])
        assert old in text
        files[name] = text.replace(old, new, 1)
        if "xacro" in new:
            files["car.xacro"] = files.pop("car.urdf")
        options = options_of(CASES[first], tmp_path)
    with pytest.raises(CalibrationError) as caught:
        import_rig(saved(files, tmp_path), **options, size_px=SIZE)
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600 + len(str(tmp_path))


@pytest.mark.parametrize(
    "name", ["camchain", "info", "urdf", "kit", "tf", "opencv", "koide", "vins"]
)
def test_no_damage_ends_in_another_error(name: str, tmp_path: Path) -> None:
    """Cut anywhere, or with bytes changed, a file is read or refused in one line."""
    suffix = {"urdf": ".urdf", "koide": ".json"}.get(name, ".yml")
    rng, path = np.random.default_rng(0), tmp_path / f"{name}{suffix}"
    whole = text_of(path.name, TEXTS[name]).encode()
    (lens,) = saved({"lens.yaml": TEXTS["info"].replace("front", "lens")}, tmp_path)
    refused = 0
    for trial in range(60):
        damaged = bytearray(whole[: rng.integers(len(whole))] if trial % 2 else whole)
        for place in rng.integers(0, max(len(damaged), 1), 3 if damaged else 0):
            damaged[place] = rng.integers(256) if trial % 3 else rng.choice(list(b"0-{[}]:<>&\n"))
        path.write_bytes(bytes(damaged))
        try:
            import_rig([path, lens], size_px=(10, 10))
        except FileError as error:
            assert str(error).startswith(str(tmp_path)) and "\n" not in str(error)
            refused += 1
        except CalibrationError as error:
            assert not re.search("[\n\r]", str(error))
            refused += 1
    assert refused > 20


def test_what_is_missing_or_unknown_is_named(tmp_path: Path) -> None:
    assert_refused("no such file", [tmp_path / "nothing.yaml"])
    koide = saved({"calib.json": TEXTS["koide"]}, tmp_path)
    assert_refused("no image size; give it with --size", koide)
    files = saved({"info.yaml": TEXTS["info"], "car.urdf": TEXTS["urdf"]}, tmp_path)
    frames = {"front": "front_cam"}
    assert_refused("no frame 'front_cam'; there are base_link", files, camera_frames=frames)
    island = TEXTS["kit"].replace("sensor_kit_base_link", "other")
    island += "car:\n  radar: {x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}\n"
    files = saved({"info.yaml": TEXTS["info"], "island.yaml": island}, tmp_path)
    assert_refused("are not connected: their roots are", files, lidar_frame="radar")


def assert_refused(said: str, files: list[Path], **options: Any) -> None:
    with pytest.raises(CalibrationError, match=re.escape(said)):
        import_rig(files, **options)


@pytest.mark.parametrize("suffix", [".yml", ".json"])
@pytest.mark.parametrize("first_line", ["%YAML:1.0", "%YAML 1.2", ""])
def test_opencv_writes_the_same_in_two_languages(
    suffix: str, first_line: str, tmp_path: Path
) -> None:
    path = tmp_path / f"front{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 1240)
    file.write("image_height", 376)
    file.write("camera_matrix", make_camera().matrix_px)
    file.write("model", "pinhole")
    file.write("distortion_coefficients", np.array(RADTAN5)[:, None])
    file.write("T_camera_lidar", FRONT)
    file.release()
    if suffix == ".yml":
        path.write_text(f"{first_line}\n{path.read_text().partition(chr(10))[2]}")
    rig = import_rig([path])
    np.testing.assert_array_equal(rig.T_camera_lidar["front"], FRONT)
    assert rig.cameras["front"].intrinsics_px == make_camera().intrinsics_px
    assert rig.cameras["front"].distortion == RADTAN5


def test_one_frame_serves_all_cameras_of_a_chain(tmp_path: Path) -> None:
    chain = TEXTS["camchain"].replace("T_cam_lidar", "T_cam_imu")
    files = saved({"chain.yaml": chain, "car.urdf": TEXTS["urdf"]}, tmp_path)
    rig = import_rig(files, camera_frames={"cam0": "front_link"})
    expected = import_rig(saved({"whole.yaml": TEXTS["camchain"]}, tmp_path))
    require_poses(rig.T_camera_lidar, expected.T_camera_lidar, atol=1e-12)


def test_a_kitti_sequence_is_imported(tmp_path: Path) -> None:
    folder = written_kitti(tmp_path / "00", frames=1)
    for path in (folder, folder / "calib.txt"):
        rig = import_rig([path])
        expected = load_rig(folder)
        assert list(rig.cameras) == ["image_2", "image_3"]
        require_poses(rig.T_camera_lidar, expected.T_camera_lidar, atol=1e-15)


def test_results_and_rig_files_are_imported_with_their_relative_poses(
    solved: Calibration, tmp_path: Path
) -> None:
    solved.save(tmp_path / "result")
    rig = import_rig([tmp_path / "result" / "calibration.yaml"])
    np.testing.assert_allclose(rig.T_camera_lidar["left"], solved.T_camera_lidar["left"])
    tied = Rig(cameras=rig.cameras, relative_poses=(stereo_relative_pose(rig),))
    tied.save(tmp_path / "rig.yaml")
    (pair,) = import_rig([tmp_path / "rig.yaml"]).relative_poses
    assert (pair.rotation_sigma_rad, pair.translation_sigma_m) == (1e-3, 2e-3)
    np.testing.assert_allclose(pair.T_a_b, tied.relative_poses[0].T_a_b, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("side", "side looks along LiDAR +y, 10 deg to the right, sits 0.40 m left and 0.10 m"),
        ("portrait", "portrait looks along LiDAR +x, its image turned by 90 deg, sits 0.40 m"),
    ],
)
def test_sentences_are_what_the_rig_was_made_of(name: str, said: str) -> None:
    (sentence,) = (text for text in describe_rig(varied_rig()) if text.startswith(name))
    assert sentence.startswith(said)


def test_up_and_down_and_the_axis_z_are_in_the_sentences() -> None:
    camera = make_camera()
    for degrees in (20, 50):
        pitched = transform(Rotation.from_euler("x", degrees, degrees=True))
        # p' = Rx(angle) p: a point on the old axis appears above, so the camera looks down.
        down = Rig(cameras={"a": camera.moved_to(pitched @ camera.T_camera_lidar)})
        said = f"a looks along LiDAR +x, {degrees} deg down, sits at the LiDAR"
        assert describe_rig(down) == [said]
    floor = Rig(cameras={"a": camera.moved_to(np.diag([1.0, -1, -1, 1]))})
    assert describe_rig(floor) == ["a looks along LiDAR -z, sits at the LiDAR"]


def test_a_camchain_is_described_with_its_relative_pose(tmp_path: Path) -> None:
    files = saved({"camchain.yaml": TEXTS["camchain"]}, tmp_path)
    rig = import_rig(files)
    assert describe_rig(rig) == [
        "cam0 looks along LiDAR +x, sits 0.40 m ahead, 0.10 m left and 0.20 m below the LiDAR",
        "cam1 looks along LiDAR +x, sits 0.40 m ahead, 0.01 m right and 0.20 m below the LiDAR",
        "cam0 sits 0.11 m left of cam1, in the axes of cam1, turned by 0.0 deg against it "
        "(1 sigma: 0.1 deg, 0.5 cm)",
    ]


def test_what_a_rig_states_of_lens_and_times_survives_an_import(tmp_path: Path) -> None:
    """Sigmas and read-out, with which a corrected guess is written again."""
    camera = make_camera().model_copy(
        update={
            "intrinsics_sigma_px": IntrinsicsSigma(focal=3.0, centre=4.0),
            "distortion_sigma": 0.01,
            "time_offset_s": 0.02,
            "time_offset_sigma_s": 0.005,
            "readout_s": 0.03,
            "readout_sigma_s": 0.002,
        }
    )
    Rig(cameras={"front": camera}).save(tmp_path / "rig.yaml")
    found = import_rig([tmp_path / "rig.yaml"]).cameras["front"]
    assert {name: getattr(found, name) for name in KNOWLEDGE} == {
        name: getattr(camera, name) for name in KNOWLEDGE
    }
