"""Clouds of a moving vehicle: brought to one time by point times, or left out."""

import logging
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError, FileError
from calibgraph.model.geometry import invert, move_points, transform
from factors import displace
from tests.vehicle.scenes import ALL_AROUND_DEG, HEIGHT_M, MOUNTS, draw_place, scan

pytestmark = pytest.mark.usefixtures("few_placements")

START_NS, SLICES, SCAN_S = 1_700_000_000_000_000_000, 12, 0.1
LATE_S = {"top": 0.0, "front": 0.03}  # the begin of its scan after the instant's stamp


def pose_at(seconds: float, speed_m_s: float) -> Array:
    """(4, 4) T_road_base of a drive along a bend."""
    turned = 0.2 * seconds * (speed_m_s > 0)
    turn = Rotation.from_euler("z", turned)
    return transform(turn, [speed_m_s * seconds, 0.5 * speed_m_s * seconds * turned, HEIGHT_M])


def sweep(boxes: Array, lidar: str, speed_m_s: float, rng: np.random.Generator, *,
          from_s: float = 0.0) -> np.ndarray:  # fmt: skip
    """(n,) x, y, z and the times of points [ns] while the vehicle drives."""
    parts = []
    for number, azimuths_deg in enumerate(np.split(ALL_AROUND_DEG, SLICES)):
        seconds = LATE_S[lidar] + SCAN_S * (number + 0.5) / SLICES
        T_road_lidar = pose_at(from_s + seconds, speed_m_s) @ MOUNTS[lidar]
        points = scan(boxes, T_road_lidar, rng, beams=12, azimuths_deg=azimuths_deg)
        parts += [(*point, round(1e9 * seconds)) for point in points.tolist()]
    return np.array(parts, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")])


def by_azimuth(cloud: np.ndarray, lidar: str) -> tuple[Array, Array]:
    """(n, 3) points, and the times [s] at which a LiDAR that turns evenly fires there."""
    points = np.column_stack([cloud[axis] for axis in "xyz"]).astype(np.float64)
    turned = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    return points, LATE_S[lidar] + SCAN_S * turned


def twist_at(speed_m_s: float) -> Array:
    """(6,) of the base at the stamp."""
    return np.array([0.0, 0.0, 0.2 * (speed_m_s > 0), speed_m_s, 0.0, 0.0])


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
    return write_rig(folder, "top", {"front": guess})


def write_rig(folder: Path, base: str, guess: dict[str, Array | None]) -> Path:
    lidars: dict[str, dict] = {base: {}}
    for name, T in guess.items():
        lidars[name] = {} if T is None else {"T_base_lidar": T.tolist()}
    content = {"format": "calibgraph-rig/1", "lidar": base, "lidars": lidars}
    (folder / "rig.yaml").write_text(yaml.safe_dump(content))
    return folder


def test_instants_that_move_are_brought_to_one_time(tmp_path, caplog):
    folder = write_drive(tmp_path, [5.0, 0.0])
    with caplog.at_level(logging.WARNING):
        result = calibgraph.calibrate(folder)
    assert "in 1 of 2 instants the vehicle moves: their clouds are brought to one" in caplog.text
    off = result.T_base_lidar["front"][:3, 3] - MOUNTS["front"][:3, 3]
    # scans last 0.1 s and begin 0.03 s apart: 15 cm as recorded
    assert np.abs(off).max() < 0.01, off
    assert (np.abs(off) < 3 * result.sigmas("front")[1] / 100).all()


@pytest.mark.slow
@pytest.mark.parametrize("stated", [False, True])
def test_clouds_corrected_before_are_named_and_are_right_where_that_is_stated(stated, tmp_path):
    folder = write_drive(tmp_path, [5.0, 5.0, 5.0])
    for path in folder.glob("lidars/*/*.npy"):
        cloud, T = np.load(path), MOUNTS[path.parent.name]
        points, times_s = by_azimuth(cloud, path.parent.name)
        moved = move_points(displace(move_points(points, T), twist_at(5.0), times_s), invert(T))
        for axis, values in zip("xyz", moved.T, strict=True):
            cloud[axis] = values
        cloud["t"] = 1e9 * times_s
        np.save(path, cloud)
    result = calibgraph.calibrate(folder, config=calibgraph.Config(instant_clouds=stated))
    lines = [line for line in result.warnings if "corrected for motion before" in line]
    assert [line.partition(":")[0] for line in lines] == ([] if stated else ["top", "front"])
    assert result.verdict.status == ("PASS" if stated else "WARN")
    off = result.T_base_lidar["front"][:3, 3] - MOUNTS["front"][:3, 3]
    assert (np.abs(off).max() < 0.01) == stated, off  # else 15 cm, with a bar of 3 mm
    if stated:
        audit = calibgraph.check(result.save(tmp_path / "out"), folder)
        assert np.abs(audit.lidars["front"].deviation[3:]).max() < 0.01


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


def write_consecutive(folder: Path, sweeps: int) -> Path:
    """Numbered sweeps 0.1 s apart at 5 m/s, with their stamps in times.txt."""
    rng = np.random.default_rng(21)
    boxes = draw_place(rng)
    for number in range(sweeps):
        for lidar in LATE_S:
            (folder / "lidars" / lidar).mkdir(parents=True, exist_ok=True)
            cloud = sweep(boxes, lidar, 5.0, rng, from_s=SCAN_S * number)
            np.save(folder / "lidars" / lidar / f"{number:03d}", cloud)
    (folder / "times.txt").write_text("\n".join(f"{SCAN_S * n:.6e}" for n in range(sweeps)))
    return write_rig(folder, "top", {"front": MOUNTS["front"]})


@pytest.mark.slow
def test_the_motion_is_found_from_consecutive_clouds(tmp_path, caplog):
    folder = write_consecutive(tmp_path, 3)
    with caplog.at_level(logging.WARNING):
        result = calibgraph.calibrate(folder)
    assert "in 3 of 3 instants the vehicle moves: their clouds are brought to one" in caplog.text
    off = result.T_base_lidar["front"][:3, 3] - MOUNTS["front"][:3, 3]
    assert np.abs(off).max() < 0.02, off  # 15 cm as recorded


@pytest.mark.parametrize(
    ("times", "message"),
    [("0.0\n0.1", "has 2 stamps for 1 clouds"), ("soon", "'soon' is no time in seconds"),
     ("nan", "'nan' is no time in seconds")],
)  # fmt: skip
def test_wrong_stamps_beside_clouds_are_named(times: str, message: str, tmp_path: Path):
    folder = write_consecutive(tmp_path, 1)
    (folder / "times.txt").write_text(times)
    with pytest.raises(FileError, match=f"times.txt: {message}"):
        calibgraph.load_dataset(folder)


AHEAD_AND_BEHIND = {
    "ahead": transform(np.eye(3)),
    "behind": transform(
        Rotation.from_euler("zyx", [178.0, 3.0, 1.0], degrees=True), [-4.2, 0.15, 0.1]
    ),
}  # fmt: skip


def write_street(folder: Path, way_m: float) -> Path:
    """Clouds every 1.5 m of a street, of LiDARs ahead and behind that are 120 degrees wide."""
    rng, lines = np.random.default_rng(22), []
    boxes = draw_place(rng, boxes=40, ahead_m=way_m)
    for number in range(int(way_m / 1.5)):
        stamp_ns, x = START_NS + number * 300_000_000, 1.5 * number
        T = transform(Rotation.from_euler("z", 0.06 * np.sin(x / 9)), [x, 0.0, HEIGHT_M])
        near = boxes[np.abs(boxes.mean(axis=1)[:, 0] - x) < 60.0]
        for lidar, mount in AHEAD_AND_BEHIND.items():
            (folder / "lidars" / lidar).mkdir(parents=True, exist_ok=True)
            azimuths_deg = np.arange(-60.0, 60.0, 0.5)
            points = scan(near, T @ mount, rng, beams=40, azimuths_deg=azimuths_deg)
            cloud = np.zeros(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("t", "u4")])
            for axis, values in zip("xyz", points.T, strict=True):
                cloud[axis] = values  # all at the stamp
            np.save(folder / "lidars" / lidar / str(stamp_ns), cloud)
        pose = [stamp_ns / 1e9, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        lines.append(" ".join(f"{value:.6f}" for value in pose))
    (folder / "poses.tum").write_text("\n".join(lines))
    return write_rig(folder, "ahead", {"behind": None})


@pytest.mark.slow
def test_lidars_that_share_nothing_are_joined_by_motion(tmp_path, caplog):
    folder = write_street(tmp_path, 105.0)
    with caplog.at_level(logging.WARNING):
        result = calibgraph.calibrate(folder)
    assert "behind and ahead share too little at one time: joined by motion, at 2" in caplog.text
    T, truth = result.T_base_lidar["behind"], AHEAD_AND_BEHIND["behind"]
    degrees, centimetres = result.sigmas("behind")
    turned = Rotation.from_matrix(T[:3, :3] @ truth[:3, :3].T).as_rotvec(degrees=True)
    off_cm = 100 * (T[:3, 3] - truth[:3, 3])
    assert np.abs(turned).max() < 0.05 and (np.abs(turned) < 3 * degrees).all()
    # Two places leave the direction along the street open: it is somewhere within its bar.
    assert np.abs(off_cm[1:]).max() < 2.0 and (np.abs(off_cm) < 3 * centimetres).all()


def test_lidars_that_share_nothing_are_refused_where_the_motion_is_unknown(tmp_path):
    folder = write_street(tmp_path, 3.0)
    message = r"'behind' shares too little with ahead: .*%.* or drive 150 m past walls, with times"
    with pytest.raises(CalibrationError, match=message):
        calibgraph.calibrate(folder)


def test_where_lidars_share_the_ground_alone_a_guess_is_begun_from(tmp_path, caplog):
    rng, nothing = np.random.default_rng(23), np.empty((0, 2, 3))
    guess = MOUNTS["left"].copy()
    guess[:3, 3] += [0.03, 0.0, 0.05]
    for lidar in ("top", "left"):
        (tmp_path / "lidars" / lidar).mkdir(parents=True)
        at = transform(np.eye(3), [0.0, 0.0, HEIGHT_M])
        np.save(tmp_path / "lidars" / lidar / "0", scan(nothing, at @ MOUNTS[lidar], rng))
    with caplog.at_level(logging.WARNING):
        result = calibgraph.calibrate(write_rig(tmp_path, "top", {"left": guess}))
    assert "'left' shares too little with top: 0 upright" in caplog.text
    assert "; begun from the guess" in caplog.text
    off = result.T_base_lidar["left"][:3, 3] - MOUNTS["left"][:3, 3]
    assert np.isclose(off[0], 0.03, atol=1e-3), "along the ground it stays"
    assert abs(off[2]) < 0.01
    assert result.verdicts["left"].cannot_tell
