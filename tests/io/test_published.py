"""Folders of published data sets hold the frames and the rig that they were written from."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from calibgraph import CalibrationError, Dataset, Rig, load_dataset, load_rig
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.io.rig_parts import quaternion_xyzw
from calibgraph.model.geometry import invert
from tests.conftest import SAMPLE, make_camera, require_poses
from tests.io.written import (
    BASELINES,
    CLOUD,
    PERIOD_US,
    RECTIFY,
    START_US,
    T_CAMERA0_LIDAR,
    tables_of,
    text_of,
    write_files,
    write_tables,
    written_kitti,
)

WIDTH, HEIGHT = 1242, 375
K = np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1]])
P_LIDAR = np.array([12.0, 1.5, -0.4, 1.0])
DRIVE = "2011_09_26_drive_0005_sync"
START_NS, SWEEP_NS, IMAGE_NS = 315967376_859506000, 100_000_000, 50_000_000
LATE_NS = 12_000_000
POSES, LENSES = "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather"
SWEEP = f"sensors/lidar/{START_NS}.feather"
Write = Callable[[Path], Path]


def write_images(folder: Path) -> None:
    folder.mkdir(parents=True)
    for frame in range(2):
        pixels = np.full((HEIGHT, WIDTH, 3), 50 + frame, np.uint8)
        cv2.imwrite(str(folder / f"{frame:010}.png"), pixels)


def projections(key: str) -> list[str]:
    return [
        text_of(key.format(number), K @ np.column_stack([np.eye(3), shift]))
        for number, shift in BASELINES.items()
    ]


def kitti_drive(date: Path) -> Path:
    drive = date / DRIVE
    lines = ["calib_time: 09-Jan-2012 13:57:47", text_of("R_rect_00", RECTIFY)]
    lines += projections("P_rect_{}")
    lines += [text_of(f"S_rect_{number}", np.array([WIDTH, HEIGHT])) for number in BASELINES]
    for number in BASELINES:
        write_images(drive / f"image_{number}" / "data")
    (date / "calib_cam_to_cam.txt").write_text("\n".join(lines))
    R, t = T_CAMERA0_LIDAR[:3, :3], T_CAMERA0_LIDAR[:3, 3]
    lines = ["calib_time: 15-Mar-2012 11:37:16", text_of("R", R), text_of("T", t), "delta_f: 0 0"]
    (date / "calib_velo_to_cam.txt").write_text("\n".join(lines))
    (drive / "velodyne_points" / "data").mkdir(parents=True)
    for frame in range(2):
        CLOUD.tofile(drive / "velodyne_points" / "data" / f"{frame:010}.bin")
    return drive


@pytest.fixture(scope="module")
def given() -> Dataset:
    """The sample's two cameras without distortion, as published images are."""
    data = load_dataset(SAMPLE)
    cameras = {n: camera for n, camera in data.rig.cameras.items() if not camera.distortion}
    frames = tuple(
        replace(frame, image_paths={name: frame.image_paths[name] for name in cameras})
        for frame in data.frames
    )
    return replace(data, rig=Rig(cameras=cameras), frames=frames)


def nuscenes(folder: Path, data: Dataset) -> Path:
    write_files(folder, data)
    write_tables(folder, tables_of(data))
    return folder


def write_columns(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path)


def argoverse(log: Path, data: Dataset, without: int | None = None) -> Path:
    """Sweeps at 10 Hz, images at 20 Hz that are late; one sweep without an image."""
    names = [*data.rig.cameras]
    for index, frame in enumerate(data.frames):
        stamp, cloud = START_NS + index * SWEEP_NS, frame.load_cloud()
        columns = {axis: cloud[:, i].astype(np.float16) for i, axis in enumerate("xyz")}
        columns["intensity"] = np.clip(cloud[:, 3], 0, 255).astype(np.uint8)
        write_columns(log / "sensors" / "lidar" / f"{stamp}.feather", columns)
        for name, source in frame.image_paths.items():
            folder = log / "sensors" / "cameras" / name
            folder.mkdir(parents=True, exist_ok=True)
            if (index, name) != (without, names[1]):
                shutil.copy(source, folder / f"{stamp + LATE_NS}{source.suffix}")
            if index + 1 < len(data.frames):  # of the next instant, too late for this sweep
                later = stamp + LATE_NS + IMAGE_NS
                shutil.copy(data.frames[0].image_paths[name], folder / f"{later}{source.suffix}")
    cameras = data.rig.cameras.values()
    lens: dict[str, Any] = {"sensor_name": names}
    for key in ("fx", "fy", "cx", "cy"):
        lens[f"{key}_px"] = [getattr(camera.intrinsics_px, key) for camera in cameras]
    for key in ("height_px", "width_px"):
        lens[key] = [getattr(camera, key) for camera in cameras]
    lens |= {key: [-0.2, -0.2] for key in ("k1", "k2", "k3")}  # of the images before
    write_columns(log / LENSES, lens)
    poses = [invert(camera.T_camera_lidar) for camera in cameras]
    pose: dict[str, Any] = {"sensor_name": names}
    for i, axis in enumerate("xyzw"):
        pose[f"q{axis}"] = [quaternion_xyzw(T)[i] for T in poses]
    for i, axis in enumerate("xyz"):
        pose[f"t{axis}_m"] = [T[i, 3] for T in poses]
    write_columns(log / POSES, pose)
    return log


@pytest.fixture(scope="module")
def folders(given: Dataset, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("published")
    (root / "date").mkdir()
    return {
        "sequence": written_kitti(root / "00"),
        "drive": kitti_drive(root / "date"),
        "nuscenes": nuscenes(root / "nuscenes", given),
        "argoverse": argoverse(root / "log", given),
    }


def copied(folders: dict[str, Path], name: str, to: Path) -> Path:
    if name == "drive":
        return Path(shutil.copytree(folders[name].parent, to / "date")) / DRIVE
    return Path(shutil.copytree(folders[name], to / name))


def test_the_extrinsics_of_a_sequence_use_the_whole_fourth_column(folders: dict[str, Path]) -> None:
    rig = load_rig(folders["sequence"])
    assert list(rig.cameras) == ["image_2", "image_3"]
    for k in (2, 3):
        expected = make_camera((0.27, 0.0, -0.08)).T_camera_lidar.copy()
        expected[:3, 3] += [-0.5 * k, 0.01 * k, 0.002 * k]
        np.testing.assert_allclose(rig.T_camera_lidar[f"image_{k}"], expected, atol=1e-12)
    assert (rig.cameras["image_2"].width_px, rig.cameras["image_2"].height_px) == (1226, 370)


def test_drives_go_through_the_rectified_frame(folders: dict[str, Path]) -> None:
    data = load_dataset(folders["drive"])
    assert [frame.name for frame in data.frames] == ["0000000000", "0000000001"]
    np.testing.assert_array_equal(data.frames[1].load_cloud(), CLOUD)
    rectified = RECTIFY @ (T_CAMERA0_LIDAR @ P_LIDAR)[:3]
    for number, shift in BASELINES.items():
        found = data.rig.cameras[f"image_{number}"]
        assert (found.width_px, found.height_px) == (WIDTH, HEIGHT)
        assert tuple(found.intrinsics_px.model_dump().values()) == (721.5, 721.5, 609.6, 172.9)
        p_camera = (found.T_camera_lidar @ P_LIDAR)[:3]
        np.testing.assert_allclose(p_camera, rectified + shift, atol=1e-12)
        assert data.frames[1].load_image(f"image_{number}", found)[0, 0, 0] == 51


@pytest.mark.parametrize("path", ["nuscenes", "nuscenes/v1.0-mini", "nuscenes/scene-0001",
                                  "nuscenes/v1.0-mini/scene-0001", "argoverse"])  # fmt: skip
def test_frames_and_rig_are_those_that_were_written(
    path: str, folders: dict[str, Path], given: Dataset
) -> None:
    name, _, rest = path.partition("/")
    data, of_nuscenes = load_dataset(folders[name] / rest), name == "nuscenes"
    assert data.rig.lidar == ("LIDAR_TOP" if of_nuscenes else "egovehicle")
    assert list(data.rig.cameras) == ["front_left", "front_right"]
    for name, camera in given.rig.cameras.items():
        found = data.rig.cameras[name]
        assert found.intrinsics_px == camera.intrinsics_px
        assert (found.width_px, found.height_px, found.distortion) == (640, 360, ())
        np.testing.assert_allclose(found.T_camera_lidar, camera.T_camera_lidar, atol=1e-12)
    start, step = (START_US, PERIOD_US) if of_nuscenes else (START_NS, SWEEP_NS)
    assert [frame.name for frame in data.frames] == [str(start + k * step) for k in range(6)]
    for one, two in zip(data.frames, given.frames, strict=True):
        cloud = two.load_cloud() if of_nuscenes else two.load_cloud().astype(np.float16)
        kept = 4 if of_nuscenes else 3
        np.testing.assert_array_equal(one.load_cloud()[:, :kept], cloud[:, :kept])
        for name, camera in given.rig.cameras.items():
            pixels = (each.load_image(name, camera) for each in (one, two))
            np.testing.assert_array_equal(*pixels)


def line(key: str, text: str) -> Callable[[Path], None]:
    """Replace the line of a key."""

    def change(path: Path) -> None:
        kept = [e for e in path.read_text().splitlines() if e.split(":")[0] != key]
        path.write_bytes("\n".join([*kept, text]).encode("latin-1"))

    return change


def columns(**values: list[Any]) -> Callable[[Path], None]:
    return lambda path: write_columns(path, values)


def pose(**values: float) -> Callable[[Path], None]:
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    return columns(sensor_name=["front_left"], **{n: [values.get(n, 0.0)] for n in names})


def record(change: dict[str, Any]) -> Callable[[Path], None]:
    """Change the first record of a table."""

    def write(path: Path) -> None:
        content = json.loads(path.read_text())
        path.write_text(json.dumps([content[0] | change, *content[1:]]))

    return write


CAM, VELO = "../calib_cam_to_cam.txt", "../calib_velo_to_cam.txt"
TABLES = "v1.0-mini/"
Row = tuple[str, str, Callable[[Path], object], str]
BROKEN: list[Row] = [
    ("sequence", "calib.txt", line("P2", "P2:" + " 0" * 12), "P2: is no camera matrix"),
    ("sequence", "calib.txt", line("P2", "P2: -7 0 6 0 0 7 2 0 0 0 1 0"), "is no camera matrix"),
    ("sequence", "calib.txt", line("P2", "P2: 1400 0 1200 0 0 1400 360 0 0 0 2 0"), "divide by 2"),
    ("sequence", "calib.txt", line("P2", "P2: 700 80 600 0 0 700 180 0 0 0 1 0"), "its skew is 80"),
    ("sequence", "calib.txt", line("", "P3: 7 0 6 0 0 7 2 0 0 0 1 0"), "P3 is given twice"),
    ("sequence", "calib.txt", line("P2", "P2: nan 0 6 0 0 7 2 0 0 0 1 0"), "expected 12 finite"),
    ("sequence", "calib.txt", line("Tr", "Tr: 1 0 0 0 0 1 0 0 0 0 -1 0"), "and the LiDAR's pose"),
    ("sequence", "calib.txt", line("Tr", "Tr: 1 0 0"), "line 'Tr' has 3 numbers, expected 12"),
    ("sequence", "calib.txt", line("P2", "\xff\xfe"), "is not UTF-8"),
    ("drive", CAM, line("R_rect_00", "R_rect_00: 1 0 0"), "line 'R_rect_00' has 3 numbers"),
    ("drive", CAM, line("S_rect_02", "S_rect_02: 1392 512"), "1392x512; take the rectified drive"),
    ("drive", CAM, line("P_rect_03", "P_rect_03: a b"), "line 'P_rect_03' has 0 numbers"),
    ("drive", VELO, line("T", "T: 0 nan 0"), "line 'T' has 3 numbers, expected 3 finite ones"),
    ("drive", VELO, line("R", "R: 1 0 0 0 1 0 0 0 -1"), "P_rect_02 and the LiDAR's pose"),
    ("drive", VELO, Path.unlink, "calib_velo_to_cam.txt: no such file"),
    ("nuscenes", f"{TABLES}sample_data.json", record({"calibrated_sensor_token": "none"}),
     "no record 'none'"),
    ("nuscenes", f"{TABLES}calibrated_sensor.json", record({"rotation": [1, 1, 0, 0]}), "1.41"),
    ("nuscenes", f"{TABLES}calibrated_sensor.json", record({"translation": [1, 2]}), "translation"),
    ("nuscenes", f"{TABLES}sensor.json", record({"modality": "sonar"}), "modality"),
    ("nuscenes", f"{TABLES}sample_data.json", record({"filename": 5}), "filename"),
    ("nuscenes", f"{TABLES}sample.json", lambda path: path.write_text("[{"), "is no JSON"),
    ("nuscenes", f"{TABLES}sample.json", lambda path: path.write_text("{}"), "no table of nuSc"),
    ("nuscenes", "samples/LIDAR_TOP/scene-0001-0.pcd.bin",
     lambda path: path.write_bytes(path.read_bytes()[:-4]), "whole number of points of 5 float32"),
    ("argoverse", LENSES, lambda path: path.write_bytes(b"no table"), "cannot be read as Feather"),
    ("argoverse", LENSES, columns(sensor_name=["a"]), "column 'fx_px' is missing"),
    ("argoverse", LENSES, columns(
        sensor_name=["front_left"], height_px=[5.0], width_px=[float("nan")],
        **{f"{key}_px": [500.0] for key in ("fx", "fy", "cx", "cy")}), "front_left: width_px"),
    ("argoverse", POSES, pose(), "has length 0, expected 1"),
    ("argoverse", SWEEP, columns(x=[1.0], y=[2.0]), "expected one z"),
    ("argoverse", SWEEP, columns(x=[None], y=[2.0], z=[1.0]), "1 empty"),
    ("argoverse", "sensors/lidar/first.feather", columns(x=[1.0]), "its name is no stamp"),
    ("argoverse", f"sensors/lidar/{10**24}.feather", columns(x=[1.0]), "its name is no stamp"),
]  # fmt: skip


@pytest.mark.parametrize("row", BROKEN, ids=lambda row: row[-1])
def test_a_broken_folder_is_one_line(row: Row, folders: dict[str, Path], tmp_path: Path) -> None:
    name, file, change, said = row
    folder = copied(folders, name, tmp_path)
    change(folder / file)
    with pytest.raises(CalibrationError, match=re.escape(said)) as caught:
        load_dataset(folder).frames[0].load_cloud()
    assert "\n" not in str(caught.value)


def without_row(path: Path) -> None:
    feather.write_feather(feather.read_table(path).slice(0, 1), path)


def without_matrix(path: Path) -> None:
    records = json.loads(path.read_text())
    of_right = (each for each in records if each["token"].endswith("front_right"))
    for each in of_right:
        each["camera_intrinsic"] = []
    path.write_text(json.dumps(records))


def without_key_frames(path: Path) -> None:
    records = json.loads(path.read_text())
    for each in records:
        each["is_key_frame"] &= "front_right" not in each["token"]
    path.write_text(json.dumps(records))


WITHOUT_A_CAMERA: list[Row] = [
    ("sequence", "calib.txt", line("P3", ""), "line 'P3' is missing: camera 'image_3'"),
    ("drive", CAM, line("P_rect_03", ""), "line 'P_rect_03' is missing: camera 'image_03'"),
    ("drive", "image_00/data", lambda path: path.mkdir(parents=True), "camera 'image_00'"),
    ("nuscenes", f"{TABLES}calibrated_sensor.json", without_matrix, "camera 'front_right'"),
    ("nuscenes", f"{TABLES}sample_data.json", without_key_frames, "camera 'front_right'"),
    ("argoverse", LENSES, without_row, "has no row of 'front_right'; found front_left: camera"),
    ("argoverse", POSES, without_row, "has no row of 'front_right'; found front_left: camera"),
]


@pytest.mark.parametrize("row", WITHOUT_A_CAMERA, ids=lambda row: row[-1])
def test_a_camera_without_a_part_is_left_out_with_a_note(
    row: Row, folders: dict[str, Path], tmp_path: Path
) -> None:
    name, file, change, said = row
    folder = copied(folders, name, tmp_path)
    change(folder / file)
    data = load_dataset(folder)
    assert len(data.rig.cameras) == (2 if "image_00" in file else 1)
    assert sum(said in note and "is left out" in note for note in data.notes) == 1
    if name == "argoverse":
        assert said in read_rig_parts([folder]).notes[0]


def test_a_sweep_without_an_image_near_enough_is_left_out(given: Dataset, tmp_path: Path) -> None:
    log = argoverse(tmp_path / "log", given, without=2)
    kept = [int(frame.name) for frame in load_dataset(log).frames]
    assert kept == [START_NS + k * SWEEP_NS for k in (0, 1, 3, 4, 5)]
    for path in (log / "sensors" / "cameras" / "front_left").iterdir():
        path.rename(path.with_stem(str(int(path.stem) + 10**12)))
    with pytest.raises(CalibrationError, match="no sweep has an image of every camera"):
        load_dataset(log)
    feather.write_feather(feather.read_table(log / LENSES).slice(0, 0), log / LENSES)
    with pytest.raises(CalibrationError, match="has no row of 'front_left'; found none"):
        load_rig(log)


def test_scenes_of_two_vehicles_are_told_apart(given: Dataset, tmp_path: Path) -> None:
    other = replace(given, rig=load_rig(SAMPLE / "reference.yaml").moved_to({}))
    other = replace(other, rig=Rig(cameras={n: other.rig.cameras[n] for n in given.rig.cameras}))
    write_files(tmp_path, given)
    same, moved = tables_of(given, scene="scene-0002"), tables_of(other, scene="scene-0003")
    write_tables(tmp_path, tables_of(given), same)
    assert len(load_rig(tmp_path).cameras) == 2  # two scenes of one vehicle
    write_tables(tmp_path, tables_of(given), same, moved)
    with pytest.raises(CalibrationError, match="2 calibrations of .*; scene-0003.; name scenes"):
        load_rig(tmp_path)
    for scene, rig in (("scene-0002", given.rig), ("scene-0003", other.rig)):
        found = load_rig(tmp_path / scene).T_camera_lidar
        require_poses(found, rig.T_camera_lidar, atol=1e-12)
    with pytest.raises(CalibrationError, match="no such scene; the tables have scene-0001, "):
        load_rig(tmp_path / "scene-0009")


def test_scans_that_are_no_key_frames_are_not_read(given: Dataset, tmp_path: Path) -> None:
    tables = tables_of(given)
    for each in tables["sample_data"]:
        each["is_key_frame"] = False
    write_tables(tmp_path, tables)
    for read in (load_rig, load_dataset):
        with pytest.raises(CalibrationError, match="has no key frame of LIDAR_TOP"):
            read(tmp_path)
