"""The rig of simulated drives, how it moves, and the picture of one such drive."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from calibgraph import Camera, IncrementalCalibrator, Intrinsics, MatcherErrors, Rig, perturb
from calibgraph.tracking.history import History
from tests.draws.drives import simulate_drive
from tests.draws.lenses import with_known_lenses

FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)
MATCHES = 200


def camera(position_m: tuple[float, float, float], yaw_deg: float) -> Camera:
    """A camera of KITTI's size."""
    turn = gtsam.Rot3.Yaw(-np.radians(yaw_deg)).matrix()
    T = np.eye(4)
    T[:3, :3] = FORWARD @ turn
    T[:3, 3] = -T[:3, :3] @ np.array(position_m)
    intrinsics = Intrinsics(fx=718.0, fy=710.0, cx=607.0, cy=185.0)
    return Camera(width_px=1240, height_px=376, intrinsics_px=intrinsics, T_camera_lidar=T)


RIG = with_known_lenses(
    Rig(
        cameras={
            "left": camera((0.3, 0.1, -0.1), 0),
            "right": camera((0.3, -0.4, -0.1), 0),
            "side": camera((0.0, 0.4, -0.1), 80),
        }
    )
)  # as the draws have them
NAMES = list(RIG.cameras)


def move_camera(rig: Rig, name: str, step: np.ndarray) -> Rig:
    """The rig after one camera moved by exp(step) in its own frame."""
    T = gtsam.Pose3.Expmap(step).matrix()
    return rig.moved_to({name: T @ rig.T_camera_lidar[name]})


def move_lidar(rig: Rig, step: np.ndarray) -> Rig:
    """The rig after its LiDAR moved by exp(step)."""
    T = gtsam.Pose3.Expmap(step).matrix()
    return rig.moved_to({name: value @ T for name, value in rig.T_camera_lidar.items()})


def random_step(rng: np.random.Generator, deg: float, cm: float) -> np.ndarray:
    """(6,) rotation and translation of exactly these sizes."""
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([np.radians(deg) * axes[0], cm / 100 * axes[1]])


def draw_picture(path: Path) -> None:
    """Draw a drive in which a camera moves, one goes blind, the LiDAR moves, and one drifts."""
    rng = np.random.default_rng(11)
    first, second = random_step(rng, 0.3, 2), random_step(rng, 0.3, 2)
    drift = random_step(rng, 0.4, 1)

    def rig_at(frame: int) -> Rig:
        rig = move_camera(RIG, "right", first) if frame >= 150 else RIG
        rig = move_lidar(rig, second) if frame >= 500 else rig
        return move_camera(rig, "left", drift * max(0, frame - 700) / 1000)

    history = History()
    tracker = IncrementalCalibrator(perturb(RIG, rotation_deg=1.0, translation_m=0.1, seed=0))
    blind_frames = {"side": range(250, 400)}
    for table in simulate_drive(
        rig_at, frames=1300, matches=MATCHES, errors=ERRORS, blind=blind_frames
    ):
        history.add(tracker.update(table))
    history.draw(path)
