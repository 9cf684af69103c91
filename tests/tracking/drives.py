"""A simulated drive, as tables in memory and as what programs send."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from calibgraph import (
    Calibration,
    Config,
    Correspondences,
    IncrementalCalibrator,
    MatcherErrors,
    Rig,
)
from calibgraph.tracking.assessment import json_lines
from calibgraph.tracking.frames import StreamFrame
from tests.conftest import make_camera
from tests.draws.drives import simulate_drive
from tests.draws.places import Drawn

FRAMES = 14
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def pair_of(**options: Any) -> Rig:
    return Rig(
        cameras={
            "left": make_camera((0.3, 0.1, -0.1), **options),
            "right": make_camera((0.3, -0.4, -0.1), **options),
        }
    )


def moved_later(rig: Rig, at: int) -> Callable[[int], Rig]:
    """The first camera moves by 3 cm and 0.6 deg."""
    name, T = next(iter(rig.T_camera_lidar.items()))
    step = np.eye(4)
    step[:2, :2] = [[np.cos(0.01), -np.sin(0.01)], [np.sin(0.01), np.cos(0.01)]]
    step[0, 3] = 0.03
    after = rig.moved_to({name: step @ T})
    return lambda frame: after if frame >= at else rig


def drive(
    rig: Rig, frames: int = FRAMES, *, moves_at: int | None = None, **options: Any
) -> list[Correspondences]:
    rig_at = moved_later(rig, frames if moves_at is None else moves_at)
    settings: dict[str, Any] = {"matches": 60, "errors": ERRORS, "seed": 1, **options}
    return list(simulate_drive(rig_at, frames=frames, **settings))


def moved(rig: Rig, name: str, step: np.ndarray) -> Rig:
    T = gtsam.Pose3.Expmap(step).matrix()
    return rig.moved_to({name: T @ rig.T_camera_lidar[name]})


def step_of(deg: float, cm: float) -> np.ndarray:
    return np.array([0, np.radians(deg), 0, cm / 100, 0, 0])


def drive_at(rig_at: Callable[[int], Rig], frames: int, **options: Any) -> list[Correspondences]:
    settings = {"matches": 100, "errors": ERRORS, "seed": 1, **options}
    return list(simulate_drive(rig_at, frames=frames, **settings))


def content_of(table: Correspondences) -> dict[str, Any]:
    """A frame as its line of JSON has it."""
    cameras = {}
    for name in table.cameras:
        own = table.of_camera(name)
        columns = (*own.pixels_px.T, *own.points_lidar_m.T, own.confidence.astype(float))
        keys = ("u_px", "v_px", "x_m", "y_m", "z_m", "confidence")
        cameras[name] = {k: c.tolist() for k, c in zip(keys, columns, strict=True)}
    metadata = table.findings.to_metadata()
    return {"frame": int(table.frame[0]), "cameras": cameras, "metadata": metadata}


def as_lines(tables: Sequence[Correspondences]) -> bytes:
    return b"".join(json.dumps(content_of(table)).encode() + b"\n" for table in tables)


def expected_lines(rig: Rig, *parts: Sequence[Correspondences], together: int = 1) -> list[str]:
    """Of frames one by one, or of some runs over tables, as ``track`` reads them."""
    tracker, lines = IncrementalCalibrator(rig), list[str]()
    for tables in parts:
        frames = [StreamFrame(int(table.frame[0]), table) for table in tables]
        for first in range(0, len(frames), together):
            for updates in tracker.update_all(frames[first : first + together]):
                assert isinstance(updates, list)
                lines += json_lines(updates)
    return lines


def file_lines(rig: Rig, *parts: Sequence[Correspondences]) -> list[str]:
    return expected_lines(rig, *parts, together=50)


def frames_in(out: str) -> list[int]:
    return [json.loads(line)["frame"] for line in out.splitlines()]


def left_out(err: str) -> list[str]:
    return [line for line in err.splitlines() if line.startswith("left out: ")]


@dataclass
class World:
    """A rig's guess and a drive, as files and in memory."""

    guess: Rig
    rig: Path
    source: Path
    tables: list[Correspondences]
    lines: list[str]
    file_lines: list[str]  # of whole files, whose frames come together


def track_draw(drawn: Drawn) -> Calibration:
    """The last estimate of a tracker that is given the frames of a draw."""
    tracker = IncrementalCalibrator(drawn.rig, Config())
    for frame in np.unique(drawn.table.frame):
        tracker.update(drawn.table.select(drawn.table.frame == frame))
    return tracker.calibration()
