"""Drives with images that are taken late, and how well their tracker does."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from calibgraph import Config, Correspondences, IncrementalCalibrator, MatcherErrors, Rig, Update
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.rigs import rig_of
from factors import Clock
from tests.draws.clocks import put_clock_error
from tests.draws.drives import simulate_drive

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.1)
OFFSET = Config(estimate=("offset",))
CONSTANT = OFFSET.changed(tracking={"walk_time_offset_s": 0.0})
STRAIGHT = np.array([0.0, 0.0, 0.0, 10.0, 0.0, 0.0])
RATE = 1.5e-5  # s from frame to frame: 45 ms in five minutes at 10 Hz


def town(frames: int, seed: int) -> np.ndarray:
    """Turns of 0.2 rad/s and speeds about 8 m/s, each of some seconds; 10 Hz."""
    rng, t = np.random.default_rng([seed, 5]), np.arange(frames) / 10

    def wave(period_s: float) -> np.ndarray:
        parts = zip(period_s * rng.uniform(0.6, 1.6, 4), rng.uniform(0, 2 * np.pi, 4), strict=True)
        return np.sum([np.sin(2 * np.pi * t / p + phase) for p, phase in parts], axis=0) / 2**0.5

    yaw, ahead = 0.2 * wave(15.0), np.clip(8 + 3 * wave(25.0), 0, 15)
    small = [0.01 * wave(3.0), 0.01 * wave(3.0)]
    return np.column_stack([*small, yaw, ahead, 0.05 * wave(5.0), np.zeros(frames)])


def late(
    twists: np.ndarray,
    offsets_s: np.ndarray,
    seed: int = 0,
    rig_at: Callable[[int], Rig] | None = None,
    **options: Any,
) -> tuple[Rig, list[Correspondences]]:
    """Two cameras like KITTI's, and frames of 100 matches, each late by its own offset."""
    rig, settings = rig_of("kitti"), {"matches": 100, "errors": ERRORS, **options}
    drive = simulate_drive(rig_at or (lambda _: rig), frames=len(twists), seed=seed, **settings)
    clocks = [Clock(value) for value in offsets_s.tolist()]
    tables = [put_clock_error(t, rig, twists, c) for t, c in zip(drive, clocks, strict=True)]
    return rig, tables


def track(rig: Rig, tables: Sequence[Correspondences], config: Config = OFFSET) -> list[Update]:
    tracker = IncrementalCalibrator(rig, config)
    return [tracker.update(table) for table in tables]


def squared_errors(update: Update, truth: Rig) -> list[float]:
    """Per camera, the mean over a pose of the squared error in the metric of its covariance."""
    found = []
    for name, T in truth.T_camera_lidar.items():
        covariance = update.covariance[name]
        assert covariance is not None
        twist = twist_between(update.T_camera_lidar[name], T)
        found.append(float(twist @ np.linalg.solve(covariance, twist)) / 6)
    return found


def offset_errors(update: Update, offset_s: float) -> list[float]:
    """Per camera, the error of its offset in sigmas."""
    return [(one.value - offset_s) / one.sigma for (one,) in update.lens.values()]


def moves(updates: Sequence[Update]) -> list[str]:
    events = [event for update in updates for event in update.events]
    return [str(event) for event in events if event.kind != "started"]
