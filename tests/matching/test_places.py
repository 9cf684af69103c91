"""Frames near each other are of one place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Dataset
from calibgraph.io.frame import Frame
from calibgraph.matching import places
from calibgraph.matching.places import Motion, PlaceFinder, find_places, motions
from tests.conftest import SAMPLE


def driving(step_m: float) -> Motion:
    """Of a camera that looks ahead: what is in front comes nearer."""
    T = np.eye(4)
    T[2, 3] = -step_m
    return T


def sample() -> tuple[Dataset, str]:
    data = calibgraph.load_dataset(SAMPLE, calibgraph.load_rig(SAMPLE / "reference.yaml"))
    return data, next(iter(data.rig.cameras))


def test_a_new_place_begins_beyond_twenty_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    data, name = sample()
    monkeypatch.setattr(places, "motions", lambda *_, **__: [driving(9.0)] * 5)
    assert find_places(data, name, data.rig.cameras[name]) == [[0, 1, 2], [3, 4, 5]]


def test_while_the_motion_is_unknown_the_place_remains(monkeypatch: pytest.MonkeyPatch) -> None:
    data, name = sample()
    steps = [driving(15.0), None, None, driving(15.0), driving(1.0)]
    monkeypatch.setattr(places, "motions", lambda *_, **__: steps)
    assert find_places(data, name, data.rig.cameras[name]) == [[0, 1, 2, 3], [4, 5]]


def test_another_recording_is_another_place(monkeypatch: pytest.MonkeyPatch) -> None:
    data, name = sample()
    elsewhere = [
        replace(frame, cloud_path=Path("other") / frame.cloud_path.name)
        for frame in data.frames[3:]
    ]
    data = replace(data, frames=(*data.frames[:3], *elsewhere))
    monkeypatch.setattr(places, "motions", lambda *_, **__: [None] * 5)
    assert find_places(data, name, data.rig.cameras[name]) == [[0, 1, 2], [3, 4, 5]]


def test_a_vehicle_that_stands_does_not_move() -> None:
    data, name = sample()
    standing = replace(data, frames=(data.frames[0], replace(data.frames[0], index=1)))
    (motion,) = motions(standing, name, data.rig.cameras[name])
    assert motion is not None
    assert np.linalg.norm(motion[:3, 3]) < 0.02


def test_a_frame_without_the_cameras_image_has_no_motion() -> None:
    data, name = sample()
    blind = replace(data.frames[1], image_paths={})
    both = replace(data, frames=(data.frames[0], blind))
    assert motions(both, name, data.rig.cameras[name]) == [None]


def test_frame_by_frame_the_places_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first camera's motion if there is one, else the next camera's."""
    data, name = sample()
    steps = [driving(15.0), None, None, driving(15.0), driving(1.0)]
    asked: list[tuple[int, int]] = []

    def motion(both: tuple[tuple[Frame, object], ...], **_: object) -> Motion:
        (before, _), (now, _) = both
        asked.append((before.index, now.index))
        return steps[before.index]

    monkeypatch.setattr(places, "_motion", motion)
    monkeypatch.setattr(places, "_detect", lambda *_: None)
    finder = PlaceFinder(data.rig)
    found = [finder.first_of_place(frame) for frame in data.frames[:6]]
    monkeypatch.setattr(places, "motions", lambda *_, **__: steps)
    expected = find_places(replace(data, frames=data.frames[:6]), name, data.rig.cameras[name])
    assert found == [place[0] for place in expected for _ in place] == [0, 0, 0, 0, 4, 4]
    cameras = len(data.rig.cameras)
    assert asked.count((0, 1)) == 1 and asked.count((1, 2)) == cameras


def test_a_frame_that_cannot_be_read_is_of_the_place_before() -> None:
    data, _ = sample()
    gone = {name: Path("gone.png") for name in data.frames[1].image_paths}
    finder = PlaceFinder(data.rig)
    frames = (data.frames[0], replace(data.frames[1], image_paths=gone))
    assert [finder.first_of_place(frame) for frame in frames] == [frames[0].index] * 2


@pytest.mark.realdata
def test_the_motion_of_a_vehicle_is_found_in_metres(realdata: Path) -> None:
    """Sequence 00 begins at 7 to 8 m/s, 10 frames a second; the steps grow evenly."""
    data = calibgraph.load_dataset(realdata / "kitti_odometry" / "sequences" / "00")
    found = motions(data, "image_2", data.rig.cameras["image_2"])
    steps = np.array([np.linalg.norm(T[:3, 3]) for T in found if T is not None])
    assert len(steps) == 9 and (steps > 0.6).all() and (steps < 0.9).all()
    assert np.abs(np.diff(steps)).max() < 0.05
    # It drives straight ahead: what is in front of the camera comes nearer.
    assert all(T[2, 3] < -0.95 * np.linalg.norm(T[:3, 3]) for T in found if T is not None)
