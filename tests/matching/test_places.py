"""Frames near each other are of one place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Dataset
from calibgraph.matching import places
from calibgraph.matching.places import Motion, find_places, motions
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
