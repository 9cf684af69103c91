"""The vehicle's frame: the road by clouds, the direction of travel by poses, what is typed."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibgraph.errors import FileError
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Vehicle
from calibgraph.vehicle.frame import Road, find_road, find_vehicle
from calibgraph.vehicle.travel import Travel, direction_of_travel, read_poses
from tests.vehicle.scenes import HEIGHT_M, draw_place, scan

R_VEHICLE_LIDAR = Rotation.from_euler("zyx", [-1.3, 2.0, 1.0], degrees=True)
AHEAD = R_VEHICLE_LIDAR.inv().apply([1.0, 0.0, 0.0])  # the vehicle's x axis, in the LiDAR's axes
YAW, PITCH = np.arctan2(AHEAD[1], AHEAD[0]), -np.arcsin(AHEAD[2])

LEVER_M = (1.1, 0.3)  # of the LiDAR, ahead of the rear axle and to the left


def drive(seed: int, *, turning: bool = False, length_m: float = 200.0) -> np.ndarray:
    """(n, 4, 4) T_world_lidar of a drive straight on and around bends, or in a circle."""
    rng = np.random.default_rng(seed)
    heading, position, poses = 0.0, np.zeros(2), []
    for metre in np.arange(0.0, length_m, 0.5):
        bend = 0.05 if turning or 60.0 < metre % 100.0 < 90.0 else 0.0
        heading += 0.25 * bend
        position = position + 0.5 * np.array([np.cos(heading), np.sin(heading)])
        heading += 0.25 * bend
        R = Rotation.from_euler("z", heading + rng.normal(0, 0.0005)) * R_VEHICLE_LIDAR
        lever = Rotation.from_euler("z", heading).apply([*LEVER_M, 0.0])[:2]
        poses.append(transform(R, [*(position + lever + rng.normal(0, 0.002, 2)), 0.0]))
    return np.array(poses)


def road_of(R_vehicle_lidar: Rotation, places: int = 5) -> Road:
    """The road by places at which the vehicle tilts by some 0.2 deg."""
    rng = np.random.default_rng(1)
    clouds = []
    for _ in range(places):
        tilt = Rotation.from_euler("xy", rng.normal(0, 0.2, 2), degrees=True)
        T = transform(tilt * R_vehicle_lidar, [0, 0, HEIGHT_M])
        clouds.append(scan(draw_place(rng), T, rng))
    road = find_road(clouds)
    assert road is not None
    return road


def test_the_direction_of_travel_is_found_from_straight_stretches():
    found = direction_of_travel(drive(1))
    assert abs(found.yaw_rad - YAW) < 4 * found.yaw_sigma_rad < 4 * np.radians(0.06)
    assert abs(found.pitch_rad - PITCH) < max(4 * found.pitch_sigma_rad, 1e-4)


def test_turns_tell_how_far_ahead_of_the_rear_axle_the_lidar_is():
    found = direction_of_travel(drive(6, length_m=600.0))
    assert abs(found.ahead_m - LEVER_M[0]) < 0.03, "wanted"
    assert 0.08 < found.ahead_sigma_m < 0.09, "with what tyres may slip"
    vehicle, notes = find_vehicle(Vehicle(), None, found)
    assert vehicle.sigmas[3] == found.ahead_sigma_m
    assert np.isclose(vehicle.T_vehicle_lidar[0, 3], found.ahead_m)
    assert not any("tell x" in note for note in notes) and any("tell y" in note for note in notes)


@pytest.mark.parametrize("poses", [drive(2, turning=True), drive(3, length_m=20.0)])
def test_circles_and_short_drives_cannot_tell(poses):
    found = direction_of_travel(poses)
    assert np.isinf(found.yaw_sigma_rad)
    vehicle, notes = find_vehicle(Vehicle(), None, found)
    assert np.isinf(vehicle.sigmas).all()
    assert "the recording cannot tell yaw of base_link: drive 50 m straight" in " ".join(notes)


def test_road_and_travel_give_roll_pitch_yaw_and_height_with_their_sigmas():
    road = road_of(R_VEHICLE_LIDAR)
    vehicle, notes = find_vehicle(Vehicle(frame="base"), road, direction_of_travel(drive(4)))
    T = vehicle.T_vehicle_lidar
    assert T is not None
    off = (Rotation.from_matrix(T[:3, :3]) * R_VEHICLE_LIDAR.inv()).as_rotvec()
    # the mean tilt of five places has 0.2 deg / sqrt(5) = 0.09 deg
    assert (np.abs(off) < 4 * vehicle.sigmas[:3]).all() and (np.abs(off) < np.radians(0.36)).all()
    assert abs(T[2, 3] - HEIGHT_M) < 0.01
    assert np.isinf(vehicle.sigmas[4]) and np.isfinite(vehicle.sigmas[[0, 1, 2, 3, 5]]).all()
    assert [note.split(" of ")[0][-1] for note in notes] == ["y"]


def test_what_is_typed_is_one_more_measurement():
    typed = transform(Rotation.from_euler("z", 2.0, degrees=True), [1.2, 0.0, 1.9])
    stated = Vehicle(
        T_vehicle_lidar=typed, rotation_sigma_rad=0.01, translation_sigma_m=(0.02, 0.02, np.inf)
    )
    vehicle, notes = find_vehicle(stated, road_of(Rotation.identity()), Travel())
    assert not notes
    np.testing.assert_allclose(vehicle.T_vehicle_lidar[:2, 3], [1.2, 0.0], atol=1e-9)
    assert abs(vehicle.T_vehicle_lidar[2, 3] - HEIGHT_M) < 0.01, "1.9 m had no weight"
    np.testing.assert_allclose(vehicle.sigmas[[2, 3, 4]], [0.01, 0.02, 0.02])
    assert vehicle.sigmas[0] < 0.01


def test_poses_are_read_as_matrices_and_as_tum(tmp_path):
    poses = drive(5, length_m=3.0)
    rows = [" ".join(map(repr, T[:3].ravel().tolist())) for T in poses]
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    numbers = np.column_stack([np.arange(len(poses)), poses[:, :3, 3], turns]).tolist()
    tum = [" ".join(map(repr, row)) for row in numbers]
    for name, lines in {
        "kitti.txt": rows, "time.csv": [f"0.1,{row.replace(' ', ',')}" for row in rows],
        "tum.txt": ["# time x y z qx qy qz qw", *tum],
    }.items():  # fmt: skip
        (tmp_path / name).write_text("\n".join(lines))
        found, times_s = read_poses(tmp_path / name)
        np.testing.assert_allclose(found, poses, atol=1e-9)
        assert (times_s is None) == (name == "kitti.txt")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n" * 2, "line 1: 3 numbers; expected 12 of a matrix"),
        ("0 0 0 0 0 0 0 2\n" * 2, "line 1: quaternion .* has length 2"),
        ("# t\n" + "1 0 0 0 0 2 0 0 0 0 1 0\n" * 2, "line 2: the upper left 3x3 is not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "holds 1 poses"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 1 0 0 0 0 1 0\n", "line 2: 12 numbers, the first line has 8"),
        ("0 a 0 0 0 0 0 1\n" * 2, "line 1: could not convert"),
    ],
)
def test_wrong_poses_are_named_with_their_line(tmp_path, text, message):
    path = tmp_path / "poses.txt"
    path.write_text(text)
    with pytest.raises(FileError, match=message):
        read_poses(path)
