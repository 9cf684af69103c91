"""Argoverse 2 logs hold the frames and the rig that they were written from."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather

from calibgraph import CalibrationError, load_dataset, load_rig
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.io.rotations import quaternion_xyzw
from calibgraph.model.geometry import invert
from tests.conftest import SAMPLE

START_NS, SWEEP_NS, IMAGE_NS = 315967376_859506000, 100_000_000, 50_000_000
LATE_NS, SPEED_M_S = 12_000_000, 10.0
CAMERAS = ("front_left", "front_right")


def written(log: Path, *, without: int | None = None) -> Path:
    """The sample as a log: sweeps at 10 Hz, images at 20 Hz that are late; a sweep without one."""
    data = load_dataset(SAMPLE)
    for index, frame in enumerate(data.frames):
        stamp = START_NS + index * SWEEP_NS
        write(log / "sensors" / "lidar" / f"{stamp}.feather", sweep(frame.load_cloud()))
        for name in CAMERAS:
            folder = log / "sensors" / "cameras" / name
            folder.mkdir(parents=True, exist_ok=True)
            source = frame.image_paths[name]
            if (index, name) != (without, CAMERAS[1]):
                shutil.copy(source, folder / f"{stamp + LATE_NS}{source.suffix}")
            if index + 1 < len(data.frames):  # of the next instant, too late for this sweep
                later = stamp + LATE_NS + IMAGE_NS
                shutil.copy(data.frames[0].image_paths[name], folder / f"{later}{source.suffix}")
    rows = [(name, data.rig.cameras[name]) for name in CAMERAS]
    lens = {
        "sensor_name": list(CAMERAS),
        **{f"{key}_px": [getattr(c.intrinsics_px, key) for _, c in rows]
           for key in ("fx", "fy", "cx", "cy")},
        **{key: [-0.2, -0.2] for key in ("k1", "k2", "k3")},  # of the images before
        "height_px": [c.height_px for _, c in rows], "width_px": [c.width_px for _, c in rows],
    }  # fmt: skip
    write(log / "calibration" / "intrinsics.feather", lens)
    poses = [invert(camera.T_camera_lidar) for _, camera in rows]
    quaternions = np.array([quaternion_xyzw(T) for T in poses])
    places = np.array([T[:3, 3] for T in poses])
    pose = {"sensor_name": list(CAMERAS)}
    pose |= {f"q{axis}": quaternions[:, i] for i, axis in enumerate("xyzw")}
    pose |= {f"t{axis}_m": places[:, i] for i, axis in enumerate("xyz")}
    write(log / "calibration" / "egovehicle_SE3_sensor.feather", pose)
    stamps = np.arange(START_NS, START_NS + 10 * SWEEP_NS, SWEEP_NS // 4)
    driven = SPEED_M_S * (stamps - START_NS) * 1e-9
    write(
        log / "city_SE3_egovehicle.feather",
        {
            "timestamp_ns": stamps[::-1],
            "tx_m": driven[::-1],
            "ty_m": 0 * driven,
            "tz_m": 0 * driven,
        },
    )
    return log


def sweep(cloud: np.ndarray) -> dict[str, np.ndarray]:
    columns = {axis: cloud[:, i].astype(np.float16) for i, axis in enumerate("xyz")}
    intensity = np.clip(cloud[:, 3], 0, 255).astype(np.uint8)
    return {**columns, "intensity": intensity, "laser_number": np.zeros(len(cloud), np.uint8)}


def write(path: Path, columns: dict[str, object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), path)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("argoverse") / "log")


def test_frames_and_rig_are_those_that_were_written(log: Path) -> None:
    data, given = load_dataset(log), load_dataset(SAMPLE)
    assert data.rig.lidar == "egovehicle"
    assert tuple(data.rig.cameras) == CAMERAS
    for name in CAMERAS:
        found, camera = data.rig.cameras[name], given.rig.cameras[name]
        assert found.intrinsics_px == camera.intrinsics_px
        assert (found.width_px, found.height_px, found.distortion) == (640, 360, ())
        np.testing.assert_allclose(found.T_camera_lidar, camera.T_camera_lidar, atol=1e-12)
    assert [f.name for f in data.frames] == [str(START_NS + k * SWEEP_NS) for k in range(6)]
    for one, two in zip(data.frames, given.frames, strict=True):
        xyz = two.load_cloud()[:, :3].astype(np.float16)
        np.testing.assert_array_equal(one.load_cloud()[:, :3], xyz.astype(np.float32))
        for name in CAMERAS:
            pixels = (each.load_image(name, given.rig.cameras[name]) for each in (one, two))
            np.testing.assert_array_equal(*pixels)


def test_how_far_the_vehicle_moves_is_in_the_notes(log: Path) -> None:
    moved = LATE_NS * 1e-9 * SPEED_M_S
    assert f"moves {moved:.2f} m (median), at most {moved:.2f} m" in load_dataset(log).notes[0]


def test_a_sweep_without_an_image_of_a_camera_is_left_out(tmp_path: Path) -> None:
    data = load_dataset(written(tmp_path / "log", without=2))
    assert [int(f.name) for f in data.frames] == [START_NS + k * SWEEP_NS for k in (0, 1, 3, 4, 5)]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("calibration/intrinsics.feather", b"no table", "cannot be read as Feather"),
        ("calibration/intrinsics.feather", {"sensor_name": ["a"]}, "column 'fx_px' is missing"),
        ("calibration/egovehicle_SE3_sensor.feather",
         {"sensor_name": ["front_left"], **{n: [0.0] for n in
          ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")}}, "has length 0, expected 1"),
        (f"sensors/lidar/{START_NS}.feather", {"x": [1.0], "y": [2.0]}, "expected one z"),
        (f"sensors/lidar/{START_NS}.feather", {"x": [None], "y": [2.0], "z": [1.0]}, "1 empty"),
        ("sensors/lidar/first.feather", {"x": [1.0]}, "its name is no stamp"),
        (f"sensors/lidar/{10**24}.feather", {"x": [1.0]}, "its name is no stamp"),
        ("calibration/intrinsics.feather",
         {"sensor_name": ["front_left"], **{n: [500.0] for n in
          ("fx_px", "fy_px", "cx_px", "cy_px", "height_px")}, "width_px": [float("nan")]},
         "front_left: width_px"),
    ],
)  # fmt: skip
def test_damaged_logs_are_refused_in_one_line(
    log: Path, tmp_path: Path, file: str, content: object, message: str
) -> None:
    copy = Path(shutil.copytree(log, tmp_path / "log"))
    if isinstance(content, bytes):
        (copy / file).write_bytes(content)
    else:
        assert isinstance(content, dict)
        write(copy / file, content)
    with pytest.raises(CalibrationError, match=re.escape(message)) as caught:
        load_rig(copy)
        load_dataset(copy).frames[0].load_cloud()
    assert "\n" not in str(caught.value)


def test_images_that_are_far_in_time_do_not_pair(log: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(log, tmp_path / "log"))
    for path in (copy / "sensors" / "cameras" / "front_left").iterdir():
        path.rename(path.with_stem(str(int(path.stem) + 10**12)))
    with pytest.raises(CalibrationError, match="no sweep has an image of every camera"):
        load_dataset(copy)


@pytest.mark.parametrize("table", ["intrinsics.feather", "egovehicle_SE3_sensor.feather"])
def test_a_camera_without_lens_or_pose_is_left_out_with_a_note(
    log: Path, tmp_path: Path, table: str
) -> None:
    copy = Path(shutil.copytree(log, tmp_path / "log"))
    path = copy / "calibration" / table
    feather.write_feather(feather.read_table(path).slice(0, 1), path)
    data = load_dataset(copy)
    assert list(data.rig.cameras) == ["front_left"] == list(load_rig(copy).cameras)
    assert len(data.frames) == 6
    said = f"{table}: has no row of 'front_right'; found front_left: camera 'front_right' is left"
    assert sum(said in note for note in data.notes) == 1
    assert said in read_rig_parts([copy]).notes[0]


def test_a_log_without_any_complete_camera_is_refused(log: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(log, tmp_path / "log"))
    path = copy / "calibration" / "intrinsics.feather"
    feather.write_feather(feather.read_table(path).slice(0, 0), path)
    with pytest.raises(CalibrationError, match="has no row of 'front_left'; found none"):
        load_rig(copy)
