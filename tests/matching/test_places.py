"""Clouds of one place are alike, and frames near each other are of one place."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Dataset, Rig
from calibgraph.io.dataset import keep_frames
from calibgraph.io.frame import Frame
from calibgraph.io.rigs import load_rig
from calibgraph.matching import places
from calibgraph.matching.cloud_similarity import Z_UP, UprightCloud, align_with_any, find_up
from calibgraph.matching.places import Motion, PlaceWalk, find_places, motions
from calibgraph.model.geometry import invert, transform
from tests.conftest import SAMPLE, make_camera

Array = NDArray[np.float64]


def _boxes(seed: int) -> Array:
    """(n, 2, 3) lower and upper corners: houses along the x axis, and lower things."""
    rng = np.random.default_rng(seed)
    n, ahead = 50, np.arange(-50.0, 100.0, 15.0)
    houses = [(x, y) for x in ahead for y in (-16.0, 16.0)]
    corner = np.vstack([houses, np.column_stack([rng.uniform(-50, 100, n), rng.uniform(4, 12, n)])])
    corner[len(houses) :, 1] *= rng.choice([-1, 1], n)
    corner += rng.uniform(-2, 2, corner.shape)
    size = rng.uniform((0.3, 0.3, 1), (3, 2, 4), (len(corner), 3))
    size[: len(houses)] = rng.uniform((6, 4, 5), (12, 8, 12), (len(houses), 3))
    low = np.column_stack([corner - size[:, :2] / 2, np.zeros(len(corner))])
    return np.stack([low, low + size], axis=1)


_BOXES = _boxes(seed=0)
_AZIMUTH, _ELEVATION = np.meshgrid(np.radians(range(360)), np.radians(range(-20, 12)))
_FLAT = np.cos(_ELEVATION)
_RAYS = np.stack([_FLAT * np.cos(_AZIMUTH), _FLAT * np.sin(_AZIMUTH), np.sin(_ELEVATION)], -1)


def _pose(x_m: float) -> Array:
    return transform(np.eye(3), [x_m, 0.0, 1.8])


STOPS = [_pose(9.0 * number) for number in range(6)]
"""(4, 4) T_world_lidar of a vehicle that drives along the street."""


@cache
def _ranges_m(pose: bytes) -> Array:
    """(n,) what a LiDAR of 32 beams measures, without noise, at (4, 4) T_world_lidar."""
    T_world_lidar = np.frombuffer(pose).reshape(4, 4)
    direction, origin = _RAYS.reshape(-1, 3) @ T_world_lidar[:3, :3].T, T_world_lidar[:3, 3]
    with np.errstate(divide="ignore"):
        range_m = np.where(direction[:, 2] < 0, -origin[2] / direction[:, 2], np.inf)
        inverse = 1.0 / direction
    for box in _BOXES:  # a ray is inside between its last entry and its first exit of three slabs
        one, other = (box[:, None] - origin) * inverse
        enters = np.minimum(one, other).max(axis=1)
        leaves = np.maximum(one, other).min(axis=1)
        hit = (enters > 0) & (enters < np.minimum(leaves, range_m))
        range_m[hit] = enters[hit]
    return np.asarray(range_m)


def scan_at(T_world_lidar: Array, seed: int) -> NDArray[np.float32]:
    """(n, 3) the points that it sees up to 80 m, with 2 cm of noise."""
    rays, range_m = _RAYS.reshape(-1, 3), _ranges_m(T_world_lidar.tobytes())
    range_m = range_m + np.random.default_rng(seed).normal(0, 0.02, len(range_m))
    seen = range_m < 80
    return (rays[seen] * range_m[seen, None]).astype(np.float32)


def displaced(T_world_lidar: Array, *, left_m: float, turned_deg: float) -> Array:
    """(4, 4) the pose beside a stop."""
    turn = Rotation.from_euler("z", turned_deg, degrees=True)
    return T_world_lidar @ transform(turn, [0.0, left_m, 0.0])


def cloud_at(T_world_lidar: Array, seed: int = 0) -> UprightCloud:
    return UprightCloud.from_cloud(scan_at(T_world_lidar, seed))


@pytest.mark.parametrize(("stop", "turned_deg"), [(0, 77.0), (1, 0.0), (1, 180.0)])
def test_the_motion_between_two_scans_of_a_place_is_found(stop: int, turned_deg: float) -> None:
    """It decides about 20 m: a twentieth is enough, and the turn between two images from above."""
    T_first = STOPS[0]
    T_now = displaced(STOPS[stop], left_m=2.0, turned_deg=turned_deg)
    first, now = cloud_at(T_first), cloud_at(T_now, seed=1)
    found = align_with_any(now, [first])
    assert found is not None
    row, T_now_first = found
    assert row == 0
    off = T_now_first @ invert(T_first) @ T_now
    assert np.linalg.norm(off[:3, 3]) < 1.0
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 1.5


def test_other_places_are_not_aligned() -> None:
    """40 m on in the same street, and in another one."""
    now = cloud_at(STOPS[5])
    other = UprightCloud.from_cloud(np.load(SAMPLE / "lidar" / "000000.npy"))
    assert align_with_any(now, [cloud_at(STOPS[0]), other]) is None


def test_of_many_known_places_the_nearest_is_found() -> None:
    known = [cloud_at(T) for T in STOPS]
    now = cloud_at(displaced(STOPS[3], left_m=1.0, turned_deg=5.0), seed=1)
    found = align_with_any(now, known)
    assert found is not None and found[0] == 3


def test_where_nothing_is_upright_nothing_is_known() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-40, 40, (5000, 2)), rng.normal(-1.8, 0.01, 5000)])
    empty = np.empty((0, 4), np.float32)
    for cloud in (flat, empty):
        assert (
            align_with_any(UprightCloud.from_cloud(cloud), [UprightCloud.from_cloud(cloud)]) is None
        )
    assert align_with_any(UprightCloud.from_cloud(flat), []) is None


AXES = {
    "optical": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "on its side": Rotation.from_euler("x", 90, degrees=True).as_matrix(),
    "upside down": Rotation.from_euler("x", 180, degrees=True).as_matrix(),
    "tilted": Rotation.from_euler("yx", (45, 20), degrees=True).as_matrix(),
}


@pytest.mark.parametrize("axes", AXES)
def test_up_is_found_in_clouds_of_other_axes_by_cameras_and_ground(axes: str) -> None:
    """To 3 deg, as exactly as the ground is level; with z up nothing is turned, to the last bit."""
    rig, cloud = load_rig(SAMPLE / "reference.yaml"), np.load(SAMPLE / "lidar" / "000000.npy")
    cameras = [*rig.T_camera_lidar.values()]
    assert find_up(cloud, cameras) is Z_UP
    T_axes_lidar = transform(AXES[axes])
    turned = cloud[:, :3] @ AXES[axes].T
    R_up_axes = find_up(turned, [T @ invert(T_axes_lidar) for T in cameras])
    assert R_up_axes is not None
    assert (R_up_axes @ AXES[axes])[2, 2] > np.cos(np.radians(3.0))


def driving(step_m: float) -> Motion:
    """Of a LiDAR that looks ahead: what is in front comes nearer."""
    return transform(np.eye(3), [-step_m, 0.0, 0.0])


def sample() -> tuple[Dataset, str]:
    data = calibgraph.load_dataset(SAMPLE, calibgraph.load_rig(SAMPLE / "reference.yaml"))
    return data, next(iter(data.rig.cameras))


def aligned_with_none(*_: object) -> None:
    pass


def test_a_new_place_begins_beyond_twenty_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    data, name = sample()
    monkeypatch.setattr(places, "motions", lambda *_, **__: [driving(9.0)] * 5)
    assert find_places(data, data.rig, name) == [[0, 1, 2], [3, 4, 5]]


def test_unlike_clouds_are_of_other_places_if_they_show_enough(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After an unknown motion; a cloud in which little stands upright stays at its place."""
    data, name = sample()
    steps = [driving(15.0), None, None, driving(15.0), driving(1.0)]
    monkeypatch.setattr(places, "motions", lambda *_, **__: steps)
    monkeypatch.setattr(places, "align_with_any", aligned_with_none)
    assert find_places(data, data.rig, name) == [[0, 1], [2], [3, 4, 5]]
    monkeypatch.setattr(places, "LEAST_UPRIGHT", 10**6)
    assert find_places(data, data.rig, name) == [[0, 1, 2, 3], [4, 5]]


@pytest.mark.parametrize(
    "axes",
    [
        ("y", 45.0),
        *(pytest.param(axes, marks=pytest.mark.slow) for axes in (("y", 180), ("x", 90))),
    ],
)
def test_the_places_do_not_depend_on_the_axes_of_the_clouds(
    axes: tuple[str, float], tmp_path: Path
) -> None:
    """Upside down, on its side and tilted, with a rig that fits."""
    data, name = sample()
    T_axes_lidar = transform(Rotation.from_euler(*axes, degrees=True))
    turned = []
    for frame in data.frames:
        cloud = np.load(frame.cloud_path)
        cloud[:, :3] = cloud[:, :3] @ T_axes_lidar[:3, :3].T
        np.save(tmp_path / frame.cloud_path.name, cloud)
        turned.append(replace(frame, cloud_path=tmp_path / frame.cloud_path.name))
    T = {n: T @ invert(T_axes_lidar) for n, T in data.rig.T_camera_lidar.items()}
    other = replace(data, frames=tuple(turned))
    expected = find_places(data, data.rig, name)
    assert len(expected) == 2
    assert find_places(other, data.rig.moved_to(T), name) == expected


# Places that were visited before


def scanned(folder: Path, poses: Iterable[Array], first: int = 0) -> list[Frame]:
    """Frames without images, numbered from the first; their noise is drawn by the number."""
    folder.mkdir(exist_ok=True)
    frames = []
    for number, T_world_lidar in enumerate(poses, start=first):
        path = folder / f"{number:06d}.npy"
        np.save(path, scan_at(T_world_lidar, seed=number))
        frames.append(Frame(number, path.stem, path, {}))
    return frames


@pytest.fixture(scope="module")
def there_and_back(tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    """Stops 9 m apart; no image shows how far it drove, so the clouds do."""
    back = [displaced(T, left_m=2.5, turned_deg=180.0) for T in reversed(STOPS)]
    return scanned(tmp_path_factory.mktemp("scans"), [*STOPS, *back])


def walked(walk: PlaceWalk, frames: Iterable[Frame]) -> list[int]:
    return [walk.first_of_place(frame, None) for frame in frames]


def test_who_turns_and_drives_back_is_at_the_same_places(there_and_back: list[Frame]) -> None:
    found = walked(PlaceWalk(), there_and_back)
    assert found[:6] == [0, 0, 0, 3, 3, 3]
    assert set(found[6:]) == {0, 3} and found[6] == 3 and found[-1] == 0


def test_two_recordings_of_a_street_have_the_same_places(tmp_path: Path) -> None:
    once = scanned(tmp_path / "once", STOPS[:4])
    again = scanned(tmp_path / "again", STOPS[:4], first=4)
    rig = Rig(cameras={"front": make_camera()})
    data = Dataset(rig=rig, frames=(*once, *again), folders=(tmp_path,))
    assert find_places(data, rig, "front") == [[0, 1, 2, 4, 5, 6], [3, 7]]


@pytest.mark.realdata
def test_even_and_odd_frames_of_a_recording_are_at_one_place(
    realdata: Path, tmp_path: Path
) -> None:
    """KITTI 00, 7 m in all; 01, of the same rig, is elsewhere."""
    whole = calibgraph.load_dataset(realdata / "kitti_odometry" / "sequences" / "00")
    other = calibgraph.load_dataset(realdata / "kitti_odometry" / "sequences" / "01")
    frames = []
    for part, chosen in enumerate((whole.frames[::2], whole.frames[1::2], other.frames)):
        (folder := tmp_path / str(part)).mkdir()
        for frame in chosen:
            (path := folder / frame.cloud_path.name).symlink_to(frame.cloud_path)
            frames.append(replace(frame, index=len(frames), cloud_path=path))
    data = replace(whole, frames=tuple(frames))
    found = find_places(data, whole.rig, "image_2")
    assert found == [list(range(10)), [10, 11, 12]]


@pytest.mark.realdata
@pytest.mark.parametrize("seed", [0, 1])
def test_a_shuffled_recording_has_the_same_places(realdata: Path, seed: int) -> None:
    """25 frames of KITTI 00; at three places it is twice, 0.4, 0.6 and 19 m apart."""
    data = keep_frames(calibgraph.load_dataset(realdata / "kitti_places"))
    order = np.random.default_rng(seed).permutation(len(data.frames))
    shuffled = data.only([data.frames[number] for number in order])
    expected = find_places(data, data.rig, "image_2")
    assert [place for place in expected if len(place) > 1] == [[0, 24], [2, 13], [3, 19]]
    found = find_places(shuffled, data.rig, "image_2")
    assert sorted(sorted(place) for place in found) == expected


@pytest.mark.realdata
def test_the_motion_of_a_vehicle_is_found_in_metres(realdata: Path) -> None:
    """Sequence 00 begins at 7 to 8 m/s, 10 frames a second; the steps grow evenly."""
    data = calibgraph.load_dataset(realdata / "kitti_odometry" / "sequences" / "00")
    found = motions(data, "image_2", data.rig.cameras["image_2"])
    steps = np.array([np.linalg.norm(T[:3, 3]) for T in found if T is not None])
    assert len(steps) == 9 and (steps > 0.6).all() and (steps < 0.9).all()
    assert np.abs(np.diff(steps)).max() < 0.05
    # It drives straight ahead: what is in front comes nearer.
    assert all(T[0, 3] < -0.95 * np.linalg.norm(T[:3, 3]) for T in found if T is not None)
