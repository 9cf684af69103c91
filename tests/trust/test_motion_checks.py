"""A motion in other units, or about other axes, is told from that which clouds show."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np
import pytest

from calibgraph import Dataset, Frame
from calibgraph.io.motion import ScanMotion
from calibgraph.model.geometry import invert
from calibgraph.trust.motion_checks import motion_doubts
from tests.conftest import make_pair

FRAMES = 30
STAMPED = [str(1_533_151_603_547_590 + 100_000 * n) for n in range(FRAMES)]  # microseconds
NUMBERED = [f"{n:06d}" for n in range(FRAMES)]
KMH = np.array([1, 1, 1, 3.6, 3.6, 3.6])


@pytest.fixture
def drive(monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """(n, 6) twists of a car in town, of which neighbouring clouds 0.1 s apart show the steps."""
    t = 0.1 * np.arange(FRAMES)
    yaw, ahead, none = 0.3 * np.sin(2 * t), 8.0 + np.sin(t), np.zeros(FRAMES)
    twists = np.column_stack([0.02 * np.sin(5 * t), 0.02 * np.cos(7 * t), yaw, ahead, none, none])
    poses = [np.eye(4)]
    for twist in twists:
        poses.append(poses[-1] @ gtsam.Pose3.Expmap(0.1 * twist).matrix())

    def register(target: int, source: int, _: Path) -> np.ndarray:
        return np.asarray(invert(poses[target]) @ poses[source])

    monkeypatch.setattr("calibgraph.io.frame.register", register)
    monkeypatch.setattr("calibgraph.io.frame.prepare_scan", lambda points: int(points[0, 0]))
    monkeypatch.setattr(Frame, "load_cloud", lambda frame: np.full((1, 4), frame.index))
    return (twists[:-1] + twists[1:]) / 2


def doubts(told: np.ndarray, stems: list[str]) -> list[str]:
    motions = [ScanMotion(tuple(twist.tolist()), 0.0) for twist in np.vstack([told[:1], told])]
    frames = [
        Frame(n, stem, Path("drive") / f"{stem}.bin", {}, find_motion=lambda n=n: motions[n])
        for n, stem in enumerate(stems)
    ]
    return motion_doubts(Dataset(rig=make_pair(), frames=tuple(frames), folders=()))


@pytest.mark.parametrize("stems", [STAMPED, NUMBERED])
def test_a_right_motion_raises_no_doubt_and_km_per_h_do(
    stems: list[str], drive: np.ndarray
) -> None:
    assert doubts(drive, stems) == []
    (text,) = doubts(drive * KMH, stems)
    assert text.endswith("is it in km/h?")
    (text,) = doubts(drive * np.repeat([1.0, 0.5], 3), stems)
    assert text.endswith("check its unit")


@pytest.mark.parametrize("order", [[0, 2, 1], [2, 1, 0], [1, 2, 0]])
def test_turns_about_other_axes_are_named(order: list[int], drive: np.ndarray) -> None:
    told = drive.copy()
    told[:, order] = drive[:, :3]
    (text,) = doubts(told, STAMPED)
    names = ", ".join(("wx", "wy", "wz")[axis] for axis in order)
    assert f"{names} in the place of wx, wy, wz would fit" in text


def test_where_clouds_are_further_apart_than_usual_the_speed_per_turn_counts(
    drive: np.ndarray,
) -> None:
    """Every frame is 0.36 s after the one before, which no name says."""
    assert doubts(drive / 3.6, NUMBERED) == []
