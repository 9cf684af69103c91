"""Points of a moving scan are moved to one instant."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph.io.motion import ScanMotion, twist_between

RNG = np.random.default_rng(4)
TURNING = (0.02, -0.05, 0.4, 12.0, 0.3, -0.1)


def pose_at(twist: tuple[float, ...], seconds: float) -> np.ndarray:
    return np.asarray(gtsam.Pose3.Expmap(np.array(twist) * seconds).matrix())


def test_a_point_ahead_of_a_vehicle_that_drives_towards_it() -> None:
    """At 10 m/s, what is 20 m ahead at the end of a scan was 21 m ahead 0.1 s before."""
    motion = ScanMotion((0, 0, 0, 10.0, 0, 0), to_s=0.1)
    moved = motion.correct(np.array([[21.0, 1, 2], [20.0, 1, 2]]), np.array([0.0, 0.1]))
    np.testing.assert_allclose(moved, [[20, 1, 2], [20, 1, 2]], atol=1e-12)


def test_a_point_beside_a_vehicle_that_turns() -> None:
    """After a quarter turn to the left, what was on the left is ahead."""
    motion = ScanMotion((0, 0, np.pi / 2, 0, 0, 0), to_s=1.0)
    moved = motion.correct(np.array([[0.0, 5, 1]]), np.zeros(1))
    np.testing.assert_allclose(moved, [[5, 0, 1]], atol=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e-9, 0.0])
def test_a_moving_scan_is_that_of_one_instant(scale: float) -> None:
    """Each point seen from where the LiDAR is at its time; turning fast, slowly and not at all."""
    twist = tuple(scale * w for w in TURNING[:3]) + TURNING[3:]
    world = RNG.uniform(-50, 50, (500, 3))
    times = RNG.uniform(-0.1, 0.1, 500)
    seen = np.array(
        [np.linalg.inv(pose_at(twist, t)) @ [*p, 1] for t, p in zip(times, world, strict=True)]
    )
    inverse = np.linalg.inv(pose_at(twist, 0.03))
    expected = world @ inverse[:3, :3].T + inverse[:3, 3]
    found = ScanMotion(twist, to_s=0.03).correct(seen[:, :3], times)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)  # 50 m of float64


def test_the_twist_is_that_of_the_poses() -> None:
    T = pose_at((0.3, 0.2, -0.1, 5, 4, 3), 1.7)
    found = twist_between(T, T @ pose_at(TURNING, 0.1), 0.1)
    np.testing.assert_allclose(found, TURNING, atol=1e-9)


def test_an_entry_keeps_the_motion() -> None:
    motion = ScanMotion(TURNING, -0.02)
    assert ScanMotion.of_entry(motion.entry()) == motion
