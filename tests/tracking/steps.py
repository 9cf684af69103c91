"""Drives in which a camera moves."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np

from calibgraph import (
    Config,
    Correspondences,
    IncrementalCalibrator,
    MatcherErrors,
    Rig,
    Update,
)
from tests.draws.drives import simulate_drive

Array = np.ndarray


ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def moved(rig: Rig, name: str, step: Array) -> Rig:
    T = gtsam.Pose3.Expmap(step).matrix()
    return rig.moved_to({name: T @ rig.T_camera_lidar[name]})


def step_of(deg: float, cm: float) -> Array:
    return np.array([0, np.radians(deg), 0, cm / 100, 0, 0])


def drive(rig_at: Callable[[int], Rig], frames: int, **options: object) -> list[Correspondences]:
    settings = {"matches": 100, "errors": ERRORS, "seed": 1, **options}
    return list(simulate_drive(rig_at, frames=frames, **settings))  # type: ignore[arg-type]


def tracked(
    guess: Rig, tables: list[Correspondences], **tracking: int
) -> tuple[IncrementalCalibrator, list[Update]]:
    tracker = IncrementalCalibrator(guess, Config().changed(tracking=tracking))
    return tracker, [tracker.update(table) for table in tables]
