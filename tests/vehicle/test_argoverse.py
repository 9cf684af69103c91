"""The two LiDARs of an Argoverse 2 log: told apart by lasers, read in their own frames, checked."""

import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.io.rig_parts import quaternion_xyzw
from calibgraph.model.geometry import invert, move_points, transform
from tests.vehicle.scenes import draw_place, scan
from tests.vehicle.test_lidars import displaced

STATED = {
    "up_lidar": transform(np.eye(3), [1.35, 0.0, 1.64]),
    "down_lidar": transform(
        Rotation.from_euler("xz", [180.0, 12.0], degrees=True), [1.355, 0.0, 1.565]
    ),
}
"""T_egovehicle_lidar as the log states it; the lower one hangs upside down."""
TRUTH = {**STATED, "down_lidar": displaced(STATED["down_lidar"], 1, 0.6, 0.05)}
BEAMS, LOWEST_DEG, HIGHEST_DEG = 32, -28.0, 14.0  # of scan
START_NS, APART_NS = 315967376_859506000, 10**10


def lasers_of(points: Array) -> Array:
    """(n,) numbers of the beams, from below."""
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(*points.T[:2])))
    steps = (elevation - LOWEST_DEG) / (HIGHEST_DEG - LOWEST_DEG) * (BEAMS - 1)
    return np.asarray(steps.round().astype(np.uint8))


def write_log(log: Path, lower: str, places: int = 3, **change: Array) -> dict[str, list[Array]]:
    """A log without images; the clouds of both LiDARs, in their own frames."""
    rng, clouds = np.random.default_rng(3), {name: list[Array]() for name in STATED}
    stated = {**STATED, **change}
    (log / "sensors" / "lidar").mkdir(parents=True)
    for place in range(places):
        boxes, parts = draw_place(rng), []
        for name, T in TRUTH.items():
            own = scan(boxes, T, rng, beams=BEAMS)
            in_ego = move_points(own, stated[name]).astype(np.float16)
            parts.append(np.column_stack([in_ego, lasers_of(own) + BEAMS * (name != lower)]))
            clouds[name].append(own)
        rows = np.concatenate(parts)
        table = {axis: rows[:, i].astype(np.float16) for i, axis in enumerate("xyz")}
        table |= {
            "intensity": np.ones(len(rows), np.uint8),
            "laser_number": rows[:, 3].astype("u1"),
        }
        name = f"{START_NS + place * APART_NS}.feather"
        feather.write_feather(pa.table(table), log / "sensors" / "lidar" / name)
    pose = {"sensor_name": [*stated]}
    pose |= {
        f"q{a}": [quaternion_xyzw(T)[i] for T in stated.values()] for i, a in enumerate("xyzw")
    }
    pose |= {f"t{a}_m": [T[i, 3] for T in stated.values()] for i, a in enumerate("xyz")}
    (log / "calibration").mkdir()
    feather.write_feather(pa.table(pose), log / "calibration" / "egovehicle_SE3_sensor.feather")
    return clouds


@pytest.mark.parametrize("lower", ["up_lidar", "down_lidar"])
def test_clouds_are_those_of_each_lidar_in_its_own_frame(lower: str, tmp_path: Path):
    written = write_log(tmp_path / "log", lower, places=1)
    data = calibgraph.load_dataset(tmp_path / "log" / "up_lidar")
    assert data.rig.lidar == "up_lidar" and not data.rig.cameras
    expected = invert(STATED["up_lidar"]) @ STATED["down_lidar"]
    np.testing.assert_allclose(data.rig.T_base_lidar["down_lidar"], expected, atol=1e-12)
    frame = data.frames[0]
    for name, (points,) in written.items():
        read, times_s = frame.load_recorded(name, timed=True)
        assert len(read) == len(points) and not times_s.any()
        # a coordinate below 128 m has steps of 6 cm in 16 bits
        np.testing.assert_allclose(read, points, atol=0.06)
    assert frame.hashes().keys() == {str(frame.cloud_path), str(frame.lidar_paths["down_lidar"])}


@pytest.mark.slow
def test_stated_extrinsics_that_are_wrong_are_found(tmp_path: Path):
    write_log(tmp_path / "log", "up_lidar")
    result = calibgraph.calibrate(tmp_path / "log" / "up_lidar")
    truth = invert(TRUTH["up_lidar"]) @ TRUTH["down_lidar"]
    off = result.T_base_lidar["down_lidar"] @ invert(truth)
    # of the 0.6 degrees and 5 cm by which it is wrong
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 0.05
    assert np.abs(off[:3, 3]).max() < 0.01
    assert result.verdict.status == "PASS"
    audit = calibgraph.check(tmp_path / "log" / "up_lidar", tmp_path / "log" / "up_lidar")
    assert audit.wrong == ("down_lidar",)


def test_lasers_that_do_not_tell_lidars_apart_are_refused(tmp_path: Path):
    write_log(tmp_path / "one", "up_lidar", places=1, down_lidar=STATED["up_lidar"])
    with pytest.raises(FileError, match="its lasers do not tell its two LiDARs apart"):
        calibgraph.load_dataset(tmp_path / "one" / "up_lidar").frames[0].load_cloud()
    write_log(tmp_path / "two", "up_lidar", places=1)
    path = next((tmp_path / "two" / "sensors" / "lidar").iterdir())
    table = feather.read_table(path)
    feather.write_feather(table.filter(np.less(table["laser_number"], BEAMS)), path)
    with pytest.raises(FileError, match=re.escape("has lasers 0 to 31, expected 0 to 63")):
        calibgraph.load_dataset(tmp_path / "two" / "up_lidar").frames[0].load_cloud()
