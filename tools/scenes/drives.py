"""The rig of simulated drives, how it moves, and the picture of one such drive."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from calibgraph import IncrementalCalibrator, Intrinsics, MatcherErrors, Rig, Update, perturb
from calibgraph.model.geometry import invert
from factors.pose_kernel import logarithms
from tests.draws.cameras import camera_at
from tests.draws.drives import simulate_drive
from tests.draws.lenses import with_known_lenses

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)
MATCHES = 200


camera = partial(camera_at, (1240, 376), Intrinsics(fx=718.0, fy=710.0, cx=607.0, cy=185.0))
"""A camera of KITTI's size."""

RIG = with_known_lenses(
    Rig(
        cameras={
            "left": camera((0.3, 0.1, -0.1)),
            "right": camera((0.3, -0.4, -0.1)),
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

    tracker = IncrementalCalibrator(perturb(RIG, rotation_deg=1.0, translation_m=0.1, seed=0))
    drive = simulate_drive(
        rig_at, frames=1300, matches=MATCHES, errors=ERRORS, blind={"side": range(250, 400)}
    )
    draw_updates([*map(tracker.update, drive)], path)


COLOURS = "#0072B2", "#E69F00", "#009E73"  # x, y, z; these differ for the colour-blind too
EVENTS = {"moved": "#D55E00", "drifts": "#A0408A", "blind": "#555555", "back": "#3399D0"}


def draw_updates(updates: Sequence[Update], path: Path) -> None:
    """Each camera's extrinsics against time, less the newest, with 3-sigma bands and events."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    events = [event for update in updates for event in update.events if event.kind in EVENTS]
    figure = Figure(figsize=(16, 1.5 + 2.5 * len(NAMES)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(NAMES), 2, sharex=True, squeeze=False)
    for name, row in zip(NAMES, panels, strict=True):
        known = [(u.frame, u.T_camera_lidar[name], u.covariance[name]) for u in updates
                 if u.covariance[name] is not None]  # fmt: skip
        frames, poses, covariances = zip(*known, strict=True)
        xi = logarithms(np.array(poses) @ invert(poses[-1]))
        sigma = 3 * np.sqrt([np.diag(own) for own in covariances])
        for panel, first, unit, what in (
            (row[0], 0, np.degrees(1.0), "rotation [deg]"), (row[1], 3, 100.0, "translation [cm]"),
        ):  # fmt: skip
            for axis, colour, label in zip(range(first, first + 3), COLOURS, "xyz", strict=True):
                curve, band = unit * xi[:, axis], unit * sigma[:, axis]
                panel.fill_between(frames, curve - band, curve + band, color=colour, alpha=0.2)
                panel.plot(frames, curve, color=colour, label=f"camera's {label}")
            for event in events:
                if event.camera in (name, None):
                    colour = EVENTS[event.kind]
                    panel.axvline(event.frame, color=colour, linewidth=1.2)
                    panel.axvspan(event.frame, event.detected_frame, color=colour, alpha=0.12)
            usual = unit * sigma[len(sigma) // 20 :, first : first + 3].max()
            middle = unit * xi[:, first : first + 3]
            panel.set_ylim(middle[10:].min() - usual, middle[10:].max() + usual)
            panel.set_ylabel(f"{name}\n{what}")
            panel.grid(color="0.9")
    for kind in dict.fromkeys(event.kind for event in events):
        panels[0, 0].plot([], [], color=EVENTS[kind], label=kind)
    for panel in panels[-1]:
        panel.set_xlabel("frame number")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=100)
