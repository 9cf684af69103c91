"""nuScenes folders hold the frames and the rig that they were written from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibgraph import CalibrationError, Dataset, Rig, calibrate, load_dataset, load_rig
from calibgraph.doctor import diagnose
from tests.cli.conftest import error_line
from tests.conftest import SAMPLE, Call
from tests.io.nuscenes_data import PERIOD_US, START_US, tables_of, write_files, write_tables


@pytest.fixture(scope="module")
def given() -> Dataset:
    """The sample's two cameras without distortion, as nuScenes' images are."""
    data = load_dataset(SAMPLE)
    cameras = {n: camera for n, camera in data.rig.cameras.items() if not camera.distortion}
    frames = tuple(
        replace(frame, image_paths={name: frame.image_paths[name] for name in cameras})
        for frame in data.frames
    )
    return replace(data, rig=Rig(cameras=cameras), frames=frames)


@pytest.fixture(scope="module")
def folder(given: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("nuscenes")
    write_files(folder, given)
    write_tables(folder, tables_of(given, moved_m=0.25))
    return folder


@pytest.mark.parametrize("path", ["", "v1.0-mini", "scene-0001", "v1.0-mini/scene-0001"])
def test_frames_and_rig_are_those_that_were_written(
    folder: Path, given: Dataset, path: str
) -> None:
    data = load_dataset(folder / path)
    assert data.rig.lidar == "LIDAR_TOP"
    assert list(data.rig.cameras) == ["front_left", "front_right"]
    for name, camera in given.rig.cameras.items():
        found = data.rig.cameras[name]
        assert found.intrinsics_px == camera.intrinsics_px
        assert (found.width_px, found.height_px, found.distortion) == (640, 360, ())
        np.testing.assert_allclose(found.T_camera_lidar, camera.T_camera_lidar, atol=1e-12)
    assert [frame.name for frame in data.frames] == [
        str(START_US + k * PERIOD_US) for k in range(6)
    ]
    for one, two in zip(data.frames, given.frames, strict=True):
        np.testing.assert_array_equal(one.load_cloud(), two.load_cloud())
        for name, camera in given.rig.cameras.items():
            pixels = (each.load_image(name, camera) for each in (one, two))
            np.testing.assert_array_equal(*pixels)


def test_how_far_the_vehicle_moves_is_stated(folder: Path) -> None:
    (note,) = load_dataset(folder).notes
    assert note.endswith(
        "the vehicle moves 0.25 m (median), at most 0.25 m, between a scan and its images"
    )
    assert note in [finding.text for finding in diagnose([folder]).findings]


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
        for name, T in rig.T_camera_lidar.items():
            np.testing.assert_allclose(found[name], T, atol=1e-12)
    with pytest.raises(CalibrationError, match="no such scene; the tables have scene-0001, "):
        load_rig(tmp_path / "scene-0009")


def test_damaged_tables_end_in_one_line(given: Dataset, tmp_path: Path, call: Call) -> None:
    tables = tables_of(given)
    write_files(tmp_path, given)
    for table, record, message in (
        ("sample_data", {"calibrated_sensor_token": "none"}, "no record 'none'"),
        ("calibrated_sensor", {"rotation": [1, 1, 0, 0]}, "has length 1.41, expected 1"),
        ("calibrated_sensor", {"translation": [1, 2]}, "translation"),
        ("sensor", {"modality": "sonar"}, "modality"),
        ("sample_data", {"width": 640, "filename": 5}, "filename"),
    ):
        spoilt = {name: [dict(each) for each in records] for name, records in tables.items()}
        spoilt[table][0].update(record)
        write_tables(tmp_path, spoilt)
        assert message in error_line(
            *call("calibrate", tmp_path, "--out", tmp_path / "out")
        ).replace("\n", ""), message
    write_tables(tmp_path, tables)
    (tmp_path / "v1.0-mini" / "sample.json").write_text("[{")
    with pytest.raises(CalibrationError, match="is no JSON"):
        load_rig(tmp_path)
    (tmp_path / "v1.0-mini" / "sample.json").write_text(json.dumps({"token": "x"}))
    with pytest.raises(CalibrationError, match="is no table of nuScenes"):
        load_rig(tmp_path)


def test_a_truncated_scan_and_a_missing_image_are_named(given: Dataset, tmp_path: Path) -> None:
    write_files(tmp_path, given)
    tables = tables_of(given)
    write_tables(tmp_path, tables)
    scan = tmp_path / "samples/LIDAR_TOP/scene-0001-0.pcd.bin"
    scan.write_bytes(scan.read_bytes()[:-4])
    with pytest.raises(
        CalibrationError, match="not a whole number of points of 5 float32; is it complete"
    ):
        load_dataset(tmp_path).frames[0].load_cloud()
    tables["sample_data"] = [
        each for each in tables["sample_data"] if each["token"] != "scene-0001-2-front_left-data"
    ]
    write_tables(tmp_path, tables)
    with pytest.raises(CalibrationError, match="has a cloud but no image of camera 'front_left'"):
        load_dataset(tmp_path)
    assert len(load_dataset(tmp_path, frames="0:2").frames) == 2


@pytest.mark.slow
def test_a_calibration_equals_that_of_our_folder(folder: Path, given: Dataset) -> None:
    one, two = calibrate(folder, given.rig), calibrate(given)
    for name in given.rig.cameras:
        np.testing.assert_array_equal(one.T_camera_lidar[name], two.T_camera_lidar[name])
        np.testing.assert_array_equal(one.covariance[name], two.covariance[name])
    assert one.verdict.status == two.verdict.status == "PASS"


def test_sweeps_without_key_frames_are_counted(given: Dataset, tmp_path: Path) -> None:
    tables = tables_of(given)
    for record in tables["sample_data"]:
        record["is_key_frame"] = False
    write_tables(tmp_path, tables)
    scans = 2 * len(given.frames)
    said = f"has {scans} scans of LIDAR_TOP, and none is a key frame; only key frames are read"
    for read in (load_rig, load_dataset):
        with pytest.raises(CalibrationError, match=said):
            read(tmp_path)
    lidar = [each for each in tables["sample_data"] if "LIDAR_TOP" not in each["token"]]
    write_tables(tmp_path, {**tables, "sample_data": lidar})
    with pytest.raises(CalibrationError, match="has no scan of LIDAR_TOP"):
        load_rig(tmp_path)


@pytest.mark.parametrize("missing", ["matrix", "key frames"])
def test_a_camera_without_a_part_is_left_out_with_a_note(
    given: Dataset, tmp_path: Path, missing: str
) -> None:
    tables = tables_of(given)
    left, right = given.rig.cameras
    if missing == "matrix":
        for record in tables["calibrated_sensor"]:
            if record["token"].endswith(right):
                record["camera_intrinsic"] = []
    for record in tables["sample_data"] if missing == "key frames" else ():
        record["is_key_frame"] &= right not in record["token"]
    write_tables(tmp_path, tables)
    write_files(tmp_path, given)
    data = load_dataset(tmp_path)
    assert list(data.rig.cameras) == [left]
    assert f"camera {right!r} is left out" in data.notes[0]
