"""Clouds joined with a wrong extrinsic are seen; one scan, and well joined ones, are not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibgraph.io.clouds import load_cloud
from calibgraph.trust.joined_clouds import displacement_of_parts
from tests.conftest import SAMPLE

CLOUD = load_cloud(SAMPLE / "lidar" / "000000.npy")
TURN = Rotation.from_euler("xyz", [1, -1, 2], degrees=True)
SHIFT_M = np.float32([0.2, -0.15, 0.1])


@pytest.mark.parametrize(
    ("first", "second"),
    [(CLOUD[::2], CLOUD[1::2]), (CLOUD, CLOUD[::3]), (CLOUD[::4], CLOUD)],
    ids=["equal", "small_last", "small_first"],
)
def test_parts_apart_are_measured(first: np.ndarray, second: np.ndarray) -> None:
    found = displacement_of_parts(
        np.concatenate([first[:, :3], TURN.apply(second[:, :3]) + SHIFT_M])
    )
    assert found is not None
    expected = np.degrees(TURN.magnitude()), np.linalg.norm(SHIFT_M)
    np.testing.assert_allclose(found, expected, atol=0.1)  # points 10 cm apart, errors of 2 cm


def test_a_scan_twice_with_a_shift_is_seen() -> None:
    shifted = CLOUD[:, :3] + np.float32([0.3, 0.0, 0.0])
    found = displacement_of_parts(np.concatenate([CLOUD[:, :3], shifted]))
    np.testing.assert_allclose(found, (0.0, 0.3), atol=0.05)


@pytest.mark.parametrize(
    "cloud",
    [
        CLOUD,
        np.concatenate([CLOUD[::2], CLOUD[1::2]]),
        CLOUD[np.argsort(np.arctan2(CLOUD[:, 1], CLOUD[:, 0]))],
        CLOUD[np.argsort(CLOUD[:, 2] / np.linalg.norm(CLOUD[:, :2], axis=1))],
        CLOUD[:150],
    ],
    ids=["scan", "joined_well", "sweep", "rings", "sparse"],
)
def test_parts_that_agree_are_left_alone(cloud: np.ndarray) -> None:
    assert displacement_of_parts(cloud) is None


def test_no_real_cloud_is_named(realdata: Path) -> None:
    clouds = [*realdata.glob("*/lidar/*"), *realdata.glob("kitti_odometry/sequences/*/velodyne/*")]
    assert len(clouds) > 30
    assert [path for path in clouds[::3] if displacement_of_parts(load_cloud(path))] == []
