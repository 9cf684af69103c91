"""Frames that determine nothing, or hold nonsense."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibgraph import (
    CorrespondenceError,
    Correspondences,
    IncrementalCalibrator,
    Rig,
    perturb,
)
from calibgraph.tracking.update import json_line
from tests.conftest import KANNALA, make_camera, stereo_relative_pose
from tests.tracking.drives import (
    drive,
    pair_of,
)


def degenerate(number: int, good: Correspondences, rng: np.random.Generator) -> Correspondences:
    """A well-formed frame that determines nothing, or holds nonsense."""
    n = len(good)
    line = np.outer(np.linspace(5, 20, n), [1.0, 0.1, 0.05])
    kinds: tuple[Callable[[], Correspondences], ...] = (
        lambda: good.select(slice(0, 0)),
        lambda: good.select(np.zeros(n, np.intp)),
        lambda: good.select(rng.permutation(n)[: rng.integers(1, 14)]),
        lambda: replace(good, points_lidar_m=np.tile(good.points_lidar_m[:1], (n, 1))),
        lambda: replace(good, points_lidar_m=line),
        lambda: replace(good, points_lidar_m=-good.points_lidar_m),
        lambda: replace(good, points_lidar_m=line / line.max() * 999_999),
        lambda: replace(good, points_lidar_m=good.points_lidar_m * [1, 1, 0]),
        lambda: replace(good, points_lidar_m=np.zeros((n, 3))),
        lambda: replace(good, pixels_px=np.tile(good.pixels_px[:1], (n, 1))),
        lambda: replace(good, pixels_px=rng.uniform(-9e5, 9e5, (n, 2))),
        lambda: replace(good, pixels_px=good.pixels_px + rng.uniform(-300, 300, 2)),
        lambda: replace(good, confidence=np.full(n, 1e-30, np.float32)),
        lambda: replace(good, confidence=np.ones(n, np.float32)),
        lambda: replace(good, information_px=np.tile([1.0, 0.0, 0.0], (n, 1))),
        lambda: replace(good, information_px=np.tile([1e-6, 0.0, 1e6], (n, 1))),
        lambda: replace(good, metadata={"systematic_rotation_rad": 1e-300}),
    )
    return kinds[number % len(kinds)]()


@pytest.mark.parametrize(
    ("kind", "share", "frames"),
    [
        ("one", 1.0, 34),
        pytest.param("fisheye", 0.4, 50, marks=pytest.mark.slow),
        ("fisheye", 1.0, 34),
        ("tied", 0.4, 50),
        ("tied", 1.0, 34),
    ],
)
def test_nonsense_neither_throws_nor_harms(kind: str, share: float, frames: int) -> None:
    """Every kind of nonsense. Warnings are errors here: no division by zero either."""
    tied = pair_of()
    rig = {
        "one": Rig(cameras={"only": make_camera()}),
        "fisheye": pair_of(model="fisheye", distortion=KANNALA),
        "tied": tied.model_copy(update={"relative_poses": (stereo_relative_pose(tied),)}),
    }[kind]
    rng = np.random.default_rng(3)
    tracker = IncrementalCalibrator(perturb(rig, rotation_deg=1, translation_m=0.1, seed=3))
    for frame, good in enumerate(drive(rig, frames)):
        table = degenerate(frame // 2, good, rng) if rng.random() < share else good
        line = json_line(tracker.update(table, frame=frame))
    again = IncrementalCalibrator.from_bytes(tracker.to_bytes())
    assert again.to_bytes() == tracker.to_bytes()
    for name, camera in json.loads(line)["cameras"].items():
        turn = np.array(camera["T_camera_lidar"]) @ np.linalg.inv(rig.T_camera_lidar[name])
        angle = np.degrees(np.arccos(np.clip((np.trace(turn[:3, :3]) - 1) / 2, -1, 1)))
        # 0.1 deg: nine times the sigma of thirty frames of 60 matches. Nonsense alone may agree.
        assert angle < 0.1 or share == 1.0


def test_the_joint_covariance_of_tied_cameras_has_no_negative_variance() -> None:
    pair = pair_of()
    tied = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    tracker = IncrementalCalibrator(perturb(tied, rotation_deg=1, translation_m=0.1, seed=3))
    for table in drive(tied, 30, failed_share=0.2):
        tracker.update(table)
        joint = tracker.calibration().joint_covariance
        if joint is not None:  # of few frames it is singular, up to rounding
            values = np.linalg.eigvalsh(joint)
            assert values[0] > -1e-12 * values[-1]


def test_frames_of_wildly_different_information_do_not_throw() -> None:
    tracker = IncrementalCalibrator(pair_of())
    for frame, table in enumerate(drive(pair_of(), 30)):
        size = 9e7 if frame % 7 == 6 else 1.0
        tracker.update(replace(table, information_px=np.tile([size, 0, size], (len(table), 1))))
    with pytest.raises(CorrespondenceError, match="information must be finite and below 1e"):
        replace(table, information_px=np.tile([1e9, 0, 1e9], (len(table), 1)))
