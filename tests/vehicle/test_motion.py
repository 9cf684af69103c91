"""Clouds of a moving vehicle: brought to one time by point times, or left out."""

import logging
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.model.geometry import transform
from tests.vehicle.scenes import ALL_AROUND_DEG, HEIGHT_M, MOUNTS, draw_place, scan

START_NS, SLICES, SCAN_S = 1_700_000_000_000_000_000, 12, 0.1
LATE_S = {"top": 0.0, "front": 0.03}  # the begin of its scan after the instant's stamp


def pose_at(seconds: float, speed_m_s: float) -> Array:
    """(4, 4) T_road_base of a drive along a bend."""
    turned = 0.2 * seconds * (speed_m_s > 0)
    turn = Rotation.from_euler("z", turned)
    return transform(turn, [speed_m_s * seconds, 0.5 * speed_m_s * seconds * turned, HEIGHT_M])


def sweep(boxes: Array, lidar: str, speed_m_s: float, rng: np.random.Generator) -> np.ndarray:
    """(n,) x, y, z and the times of points [ns] while the vehicle drives."""
    parts = []
    for number, azimuths_deg in enumerate(np.split(ALL_AROUND_DEG, SLICES)):
        seconds = LATE_S[lidar] + SCAN_S * (number + 0.5) / SLICES
        T_road_lidar = pose_at(seconds, speed_m_s) @ MOUNTS[lidar]
        points = scan(boxes, T_road_lidar, rng, azimuths_deg=azimuths_deg)
        parts += [(*point, round(1e9 * seconds)) for point in points.tolist()]
    return np.array(parts, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")])


def write_drive(folder: Path, speeds_m_s: list[float]) -> Path:
    """A dataset of instants with these speeds, and TUM poses 0.05 s apart about each."""
    rng, lines = np.random.default_rng(20), []
    for number, speed in enumerate(speeds_m_s):
        boxes, stamp_ns = draw_place(rng), START_NS + number * 10**10
        for lidar in LATE_S:
            (folder / "lidars" / lidar).mkdir(parents=True, exist_ok=True)
            np.save(folder / "lidars" / lidar / str(stamp_ns), sweep(boxes, lidar, speed, rng))
        for seconds in np.arange(-0.3, 0.31, 0.05):
            T = pose_at(seconds, speed)
            turn = Rotation.from_matrix(T[:3, :3]).as_quat()
            values = [stamp_ns / 1e9 + seconds, *T[:3, 3], *turn]
            lines.append(" ".join(f"{value:.6f}" for value in values))
    (folder / "poses.tum").write_text("\n".join(lines))
    guess = MOUNTS["front"].copy()
    guess[:3, 3] += [0.05, -0.05, 0.05]
    lidars = {"top": {}, "front": {"T_base_lidar": guess.tolist()}}
    content = {"format": "calibgraph-rig/1", "lidar": "top", "lidars": lidars}
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return folder


def test_instants_that_move_are_brought_to_one_time(tmp_path, caplog):
    folder = write_drive(tmp_path, [5.0, 0.0, 5.0])
    with caplog.at_level(logging.WARNING):
        result = calibgraph.calibrate(folder)
    assert "in 2 of 3 instants the vehicle moves: their clouds are brought to one" in caplog.text
    off = result.T_base_lidar["front"][:3, 3] - MOUNTS["front"][:3, 3]
    # scans last 0.1 s and begin 0.03 s apart: 15 cm as recorded
    assert np.abs(off).max() < 0.01, off
    assert (np.abs(off) < 3 * result.sigmas("front")[1] / 100).all()


def test_instants_that_move_are_left_out_where_points_have_no_times(tmp_path, caplog):
    folder = write_drive(tmp_path, [0.0, 5.0])
    for path in folder.glob("lidars/*/*.npy"):
        cloud = np.load(path)
        np.save(path, np.column_stack([cloud[axis] for axis in "xyz"]))
    with caplog.at_level(logging.WARNING):
        result = calibgraph.calibrate(folder)
    assert "1 of 2 instants are left out: the vehicle moves, and points have no" in caplog.text
    assert np.abs(result.T_base_lidar["front"] - MOUNTS["front"]).max() < 0.01
    for path in folder.glob(f"lidars/*/{START_NS}.npy"):
        path.unlink()
    with pytest.raises(DatasetError, match="in all 1 instants the vehicle moves, and points have"):
        calibgraph.calibrate(folder)
