"""What the tracker notices: simulated drives in which something moves, or nothing does.

    python benchmarks/events.py --runs 100 --jobs 2 [scenario ...]

Each run has its own rig guess, scene, noise, time and direction of the event.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import gtsam
import numpy as np

from calibgraph import Camera, IncrementalCalibrator, Intrinsics, MatcherErrors, Rig, perturb
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.correspondences import simulate_drive
from calibgraph.tracking.history import History

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


RIG = Rig(
    cameras={
        "left": camera((0.3, 0.1, -0.1), 0),
        "right": camera((0.3, -0.4, -0.1), 0),
        "side": camera((0.0, 0.4, -0.1), 80),
    }
)
NAMES = list(RIG.cameras)


@dataclass(frozen=True)
class Outcome:
    """One run.

    Attributes:
        detected: whether the event that was made was told.
        attributed: whether all alarms named what it was.
        delay: frames from the event to its alarm.
        false_alarms: alarms before the event, or after the first of it.
        frames: of the run.
        error_deg, error_cm: largest over the cameras, at the end.
        error_sigmas: largest component of the errors at the end, in sigmas.
    """

    detected: bool
    attributed: bool
    delay: float
    false_alarms: int
    frames: int
    error_deg: float
    error_cm: float
    error_sigmas: float
    said: tuple[str, ...]


def moved(rig: Rig, name: str, step: np.ndarray) -> Rig:
    """The rig after one camera moved by exp(step) in its own frame."""
    T = gtsam.Pose3.Expmap(step).matrix()
    return rig.moved_to({name: T @ rig.T_camera_lidar[name]})


def lidar_moved(rig: Rig, step: np.ndarray) -> Rig:
    """The rig after its LiDAR moved by exp(step)."""
    T = gtsam.Pose3.Expmap(step).matrix()
    return rig.moved_to({name: value @ T for name, value in rig.T_camera_lidar.items()})


def random_step(rng: np.random.Generator, deg: float, cm: float) -> np.ndarray:
    """(6,) rotation and translation of exactly these sizes."""
    axes = rng.standard_normal((2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([np.radians(deg) * axes[0], cm / 100 * axes[1]])


def drive(
    rig_at: Callable[[int], Rig], frames: int, seed: int, **options: object
) -> tuple[list, dict]:
    """Track a simulated drive: its alarms, and the errors of the last estimate."""
    tracker = IncrementalCalibrator(perturb(RIG, rotation_deg=1.0, translation_m=0.1, seed=seed))
    events = []
    for table in simulate_drive(
        rig_at, frames=frames, matches=MATCHES, errors=ERRORS, seed=seed, **options
    ):
        update = tracker.update(table)
        events += [event for event in update.events if event.kind not in ("started", "back")]
    errors = {"error_deg": 0.0, "error_cm": 0.0, "error_sigmas": 0.0}
    for name, T in rig_at(frames - 1).T_camera_lidar.items():
        xi = twist_between(T, update.T_camera_lidar[name])
        covariance = update.covariance[name]
        sigmas = np.abs(xi) / np.sqrt(np.diag(np.eye(6) if covariance is None else covariance))
        for key, value in (
            ("error_deg", np.degrees(np.linalg.norm(xi[:3]))),
            ("error_cm", 100 * np.linalg.norm(xi[3:])),
            ("error_sigmas", sigmas.max()),
        ):
            errors[key] = max(errors[key], float(value))
    return events, errors


def judged(
    events: list, errors: dict, frames: int, *, at: int, kind: str, who: str | None
) -> Outcome:
    """Compare what was told with what happened."""
    after = [e for e in events if e.detected_frame >= at and e.kind in (kind, "drifts", "moved")]
    right = [e for e in after if e.camera == who]
    return Outcome(
        detected=bool(after),
        attributed=bool(after) and all(e.camera == who for e in after),
        delay=right[0].detected_frame - at if right else np.nan,
        false_alarms=len(events) - min(len(right), 1),
        frames=frames,
        **errors,
        said=tuple(f"{e.kind} {e.camera} {e.frame}->{e.detected_frame}" for e in events),
    )


def nothing(seed: int, frames: int = 1000) -> Outcome:
    """Nothing moves."""
    events, errors = drive(lambda frame: RIG, frames, seed)
    said = tuple(f"{e.kind} {e.camera} {e.detected_frame}" for e in events)
    return Outcome(not events, not events, np.nan, len(events), frames, **errors, said=said)


def step_of_camera(seed: int, failed_share: float = 0.0) -> Outcome:
    """One camera moves by 0.3 deg and 2 cm."""
    rng = np.random.default_rng(seed + 1_000_000)
    who, at, step = str(rng.choice(NAMES)), int(rng.integers(100, 200)), random_step(rng, 0.3, 2)
    after = moved(RIG, who, step)
    frames = at + 150
    events, errors = drive(
        lambda frame: after if frame >= at else RIG, frames, seed, failed_share=failed_share
    )
    return judged(events, errors, frames, at=at, kind="moved", who=who)


def step_of_lidar(seed: int) -> Outcome:
    """The LiDAR moves by 0.3 deg and 2 cm."""
    rng = np.random.default_rng(seed + 1_000_000)
    at, step = int(rng.integers(100, 200)), random_step(rng, 0.3, 2)
    after = lidar_moved(RIG, step)
    events, errors = drive(lambda frame: after if frame >= at else RIG, at + 150, seed)
    return judged(events, errors, at + 150, at=at, kind="moved", who=None)


def slow_drift(seed: int) -> Outcome:
    """One camera turns by 0.5 deg in 5000 frames, after 200 in which it stands still."""
    rng = np.random.default_rng(seed + 1_000_000)
    who, step = str(rng.choice(NAMES)), random_step(rng, 0.5, 0)

    def rig_at(frame: int) -> Rig:
        return moved(RIG, who, step * max(0, frame - 200) / 5000)

    events, errors = drive(rig_at, 5200, seed)
    return judged(events, errors, 5200, at=200, kind="drifts", who=who)


def slow_drift_of_lidar(seed: int) -> Outcome:
    """The LiDAR turns by 0.5 deg in 5000 frames, after 200 in which it stands still."""
    rng = np.random.default_rng(seed + 1_000_000)
    step = random_step(rng, 0.5, 0)

    def rig_at(frame: int) -> Rig:
        return lidar_moved(RIG, step * max(0, frame - 200) / 5000)

    events, errors = drive(rig_at, 2200, seed)
    return judged(events, errors, 2200, at=200, kind="drifts", who=None)


def garbage(seed: int) -> Outcome:
    """30 % of the frames have wrong matches; nothing moves."""
    events, errors = drive(lambda frame: RIG, 500, seed, failed_share=0.3)
    said = tuple(f"{e.kind} {e.camera} {e.detected_frame}" for e in events)
    return Outcome(not events, not events, np.nan, len(events), 500, **errors, said=said)


def blind(seed: int) -> Outcome:
    """A camera sees nothing for 500 frames, then again."""
    rng = np.random.default_rng(seed + 1_000_000)
    who, at = str(rng.choice(NAMES)), int(rng.integers(100, 200))
    frames = at + 650
    hidden = {who: range(at, at + 500)}
    events, errors = drive(lambda frame: RIG, frames, seed, blind=hidden)
    return judged(events, errors, frames, at=at, kind="blind", who=who)


SCENARIOS: dict[str, Callable[[int], Outcome]] = {
    "nothing": nothing,
    "step_of_camera": step_of_camera,
    "step_of_lidar": step_of_lidar,
    "garbage": garbage,
    "step_in_garbage": partial(step_of_camera, failed_share=0.3),
    "blind": blind,
    "slow_drift": slow_drift,
    "slow_drift_of_lidar": slow_drift_of_lidar,
}


def picture(path: Path) -> None:
    """Draw a drive in which a camera moves, one goes blind, the LiDAR moves, and one drifts."""
    rng = np.random.default_rng(11)
    first, second = random_step(rng, 0.3, 2), random_step(rng, 0.3, 2)
    drift = random_step(rng, 0.4, 1)

    def rig_at(frame: int) -> Rig:
        rig = moved(RIG, "right", first) if frame >= 150 else RIG
        rig = lidar_moved(rig, second) if frame >= 500 else rig
        return moved(rig, "left", drift * max(0, frame - 700) / 1000)

    history = History()
    tracker = IncrementalCalibrator(perturb(RIG, rotation_deg=1.0, translation_m=0.1, seed=0))
    blind_frames = {"side": range(250, 400)}
    for table in simulate_drive(
        rig_at, frames=1300, matches=MATCHES, errors=ERRORS, blind=blind_frames
    ):
        history.add(tracker.update(table))
    history.draw(path)


def main() -> None:
    """Run scenarios, print a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", nargs="*", default=list(SCENARIOS))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="print what each run was told")
    parser.add_argument("--picture", type=Path, help="draw the README's picture, and no more")
    arguments = parser.parse_args()
    if arguments.picture is not None:
        picture(arguments.picture)
        return
    seeds = range(arguments.first, arguments.first + arguments.runs)
    for name in arguments.scenario:
        start = time.perf_counter()
        with ProcessPoolExecutor(arguments.jobs) as pool:
            outcomes = list(pool.map(SCENARIOS[name], seeds))
        print(f"{summary(name, outcomes)}; {time.perf_counter() - start:.0f} s", flush=True)
        if arguments.verbose:
            for seed, outcome in zip(seeds, outcomes, strict=True):
                if not outcome.attributed or outcome.false_alarms:
                    print("   ", seed, outcome.said, outcome.delay)


def summary(name: str, outcomes: list[Outcome]) -> str:
    """One line."""

    def of(column: str) -> np.ndarray:
        return np.array([getattr(outcome, column) for outcome in outcomes], dtype=float)

    delays = of("delay")[~np.isnan(of("delay"))]
    delay = f"delay median {np.median(delays):.0f}, max {delays.max():.0f}; " if len(delays) else ""
    frames = of("frames").sum()
    return (
        f"{name}: detected {of('detected').mean():.0%}, attributed {of('attributed').mean():.0%}; "
        f"{delay}false alarms {of('false_alarms').sum():.0f} in {frames:.0f} frames; errors after: "
        f"median {np.median(of('error_deg')):.3f} deg {np.median(of('error_cm')):.2f} cm, "
        f"95 % {np.quantile(of('error_deg'), 0.95):.3f} deg "
        f"{np.quantile(of('error_cm'), 0.95):.2f} cm, "
        f"largest component {np.median(of('error_sigmas')):.1f} sigma (median of runs)"
    )


if __name__ == "__main__":
    main()
