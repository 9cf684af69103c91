"""Frames near each other are of one place."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Dataset, Rig
from calibgraph.io.frame import Frame
from calibgraph.io.kept_frames import keep_frames
from calibgraph.matching import places
from calibgraph.matching.places import Motion, PlaceFinder, PlaceWalk, find_places, motions
from calibgraph.model.geometry import invert, transform
from tests.conftest import SAMPLE, make_camera
from tests.matching.streets import STOPS, displaced, scan_at

Array = NDArray[np.float64]


def driving(step_m: float) -> Motion:
    """Of a LiDAR that looks ahead: what is in front comes nearer."""
    T = np.eye(4)
    T[0, 3] = -step_m
    return T


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


@pytest.mark.parametrize("axes", [("y", 180.0), ("x", 90.0), ("y", 45.0)])
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


def test_frame_by_frame_the_places_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first camera's motion if there is one, else the next camera's."""
    data, name = sample()
    steps = [driving(15.0), None, None, driving(15.0), driving(1.0)]
    asked: list[tuple[int, int]] = []

    def motion(both: tuple[tuple[Frame, object], ...], **_: object) -> Motion:
        (before, _), (now, _) = both
        asked.append((before.index, now.index))
        return steps[before.index]

    monkeypatch.setattr(places, "align_with_any", aligned_with_none)
    monkeypatch.setattr(places, "_motion", motion)
    monkeypatch.setattr(places, "_detect", lambda *_: None)
    finder = PlaceFinder(data.rig)
    found = [finder.first_of_place(frame) for frame in data.frames[:6]]
    monkeypatch.setattr(places, "motions", lambda *_, **__: steps)
    monkeypatch.setattr(places, "LEAST_UPRIGHT", 10**6)  # after an unknown motion it stays, too
    expected = find_places(replace(data, frames=data.frames[:6]), data.rig, name)
    assert found == [place[0] for place in expected for _ in place] == [0, 0, 0, 0, 4, 4]
    cameras = len(data.rig.cameras)
    assert asked.count((0, 1)) == 1 and asked.count((1, 2)) == cameras


@pytest.mark.parametrize(
    ("names", "places_found"),
    [
        (("000000", "000001"), [0, 0]),
        (("000000", "000185"), [0, 1]),
        ((f"{10**15}", f"{10**15 + 10**6}"), [0, 0]),
        ((f"{10**15}", f"{10**15 + 20 * 10**6}"), [0, 1]),
        (("here", "there"), [0, 0]),
    ],
)
def test_a_frame_stays_after_an_unknown_motion_if_it_follows_closely(
    names: tuple[str, str], places_found: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By stamps, or else by numbers: unlike clouds of frames far apart are of other places."""
    monkeypatch.setattr(places, "align_with_any", aligned_with_none)
    data, _ = sample()
    frames = [replace(f, name=name) for f, name in zip(data.frames, names, strict=False)]
    walk = PlaceWalk(in_sequence=True)
    assert [walk.first_of_place(frame, None) for frame in frames] == places_found


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


def test_a_remembered_place_is_recognised(tmp_path: Path) -> None:
    poses = [STOPS[0], STOPS[5], STOPS[1]]
    frames = scanned(tmp_path, poses)
    walk = PlaceWalk()
    for frame in frames[:2]:
        walk.remember(frame)
    assert walked(walk, frames[2:]) == [0]


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
