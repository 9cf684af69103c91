"""What the tracker detects: simulated drives in which something moves, or nothing does.

    python -m benchmarks.accuracy.events --runs 100 --jobs 2 [scenario ...]
    python -m benchmarks.accuracy.events --picture data/track.png

Each run has its own rig guess, scene, noise, time and direction of the event.
"""

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import Table, parser_of, publish
from calibgraph import IncrementalCalibrator, Rig, perturb
from calibgraph.model.geometry import twist_between
from tests.draws.drives import simulate_drive
from tools.scenes.drives import (
    ERRORS,
    MATCHES,
    NAMES,
    RIG,
    draw_picture,
    move_camera,
    move_lidar,
    random_step,
)


@dataclass(frozen=True)
class Outcome:
    """One run.

    Attributes:
        detected: whether the simulated event was reported.
        attributed: whether all its reports name the right camera, or the LiDAR.
        delay: frames from the event to its report; NaN if there is none.
        false_alarms: reports before the event, or after the first of it.
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


def drive(
    rig_at: Callable[[int], Rig], frames: int, seed: int, *, at: int = 0, kind: str = "",
    who: str | None = None, **options: Any,
) -> Outcome:  # fmt: skip
    """Track a simulated drive, and compare the reports with what happened.

    Args:
        rig_at: the rig at a frame.
        frames: of the drive.
        seed: of the guess and the matches.
        at: frame of the event.
        kind: of the event; nothing happens without one.
        who: camera of the event; the LiDAR if None.
        options: of :func:`simulate_drive`.
    """
    tracker = IncrementalCalibrator(perturb(RIG, rotation_deg=1.0, translation_m=0.1, seed=seed))
    events, sizes = [], []
    for table in simulate_drive(
        rig_at, frames=frames, matches=MATCHES, errors=ERRORS, seed=seed, **options
    ):
        update = tracker.update(table)
        events += [event for event in update.events if event.kind not in ("started", "back")]
    for name, T in rig_at(frames - 1).T_camera_lidar.items():
        xi, covariance = twist_between(T, update.T_camera_lidar[name]), update.covariance[name]
        sigmas = np.sqrt(np.diag(np.eye(6) if covariance is None else covariance))
        sizes.append((np.degrees(np.linalg.norm(xi[:3])), 100 * np.linalg.norm(xi[3:]),
                      np.max(np.abs(xi) / sigmas)))  # fmt: skip
    after = [e for e in events if e.detected_frame >= at and e.kind in (kind, "drifts", "moved")]
    right = [e for e in after if e.camera == who] if kind else []
    named = bool(after) and all(e.camera == who for e in after)
    return Outcome(
        bool(after) if kind else not events, named if kind else not events,
        right[0].detected_frame - at if right else np.nan, len(events) - min(len(right), 1), frames,
        *(float(value) for value in np.max(sizes, axis=0)),
    )  # fmt: skip


def still(seed: int, frames: int, **options: Any) -> Outcome:
    """Nothing moves."""
    return drive(lambda frame: RIG, frames, seed, **options)


def step(seed: int, *, of_lidar: bool = False, **options: Any) -> Outcome:
    """One camera, or the LiDAR, moves by 0.3 deg and 2 cm."""
    rng = np.random.default_rng(seed + 1_000_000)
    who = None if of_lidar else str(rng.choice(NAMES))
    at, twist = int(rng.integers(100, 200)), random_step(rng, 0.3, 2)
    after = move_lidar(RIG, twist) if who is None else move_camera(RIG, who, twist)
    rig_at: Callable[[int], Rig] = lambda frame: after if frame >= at else RIG  # noqa: E731
    return drive(rig_at, at + 150, seed, at=at, kind="moved", who=who, **options)


def slow_drift(seed: int, *, frames: int, of_lidar: bool = False) -> Outcome:
    """One camera, or the LiDAR, turns by 0.5 deg in 5000 frames, after 200 without motion."""
    rng = np.random.default_rng(seed + 1_000_000)
    who = None if of_lidar else str(rng.choice(NAMES))
    twist = random_step(rng, 0.5, 0)

    def rig_at(frame: int) -> Rig:
        turned = twist * max(0, frame - 200) / 5000
        return move_lidar(RIG, turned) if who is None else move_camera(RIG, who, turned)

    return drive(rig_at, frames, seed, at=200, kind="drifts", who=who)


def blind(seed: int) -> Outcome:
    """A camera sees nothing for 500 frames, then again."""
    rng = np.random.default_rng(seed + 1_000_000)
    who, at = str(rng.choice(NAMES)), int(rng.integers(100, 200))
    hidden = {who: range(at, at + 500)}
    return still(seed, at + 650, at=at, kind="blind", who=who, blind=hidden)


SCENARIOS: dict[str, Callable[[int], Outcome]] = {
    "nothing": partial(still, frames=1000),
    "step_of_camera": step,
    "step_of_lidar": partial(step, of_lidar=True),
    "garbage": partial(still, frames=500, failed_share=0.3),  # wrong matches
    "step_in_garbage": partial(step, failed_share=0.3),
    "blind": blind,
    "slow_drift": partial(slow_drift, frames=5200),
    "slow_drift_of_lidar": partial(slow_drift, frames=2200, of_lidar=True),
}

COLUMNS = (
    "drive", "runs", "detected", "rightly named", "frames until reported: median", "longest",
    "false alarms", "frames in all", "error after: median [deg]", "[cm]", "95 % [deg]", "[cm]",
    "largest component, median [sigma]",
)  # fmt: skip


def cells(name: str, outcomes: list[Outcome]) -> tuple[str, ...]:
    """The row of a scenario."""
    values = {
        column: np.array([getattr(outcome, column) for outcome in outcomes], dtype=float)
        for column in Outcome.__dataclass_fields__
    }
    delays = values["delay"][~np.isnan(values["delay"])]
    deg, cm = values["error_deg"], values["error_cm"]
    return (
        name, str(len(outcomes)), f"{values['detected'].mean():.0%}",
        f"{values['attributed'].mean():.0%}", f"{np.median(delays):.0f}" if len(delays) else "",
        f"{delays.max():.0f}" if len(delays) else "", f"{values['false_alarms'].sum():.0f}",
        f"{values['frames'].sum():.0f}", f"{np.median(deg):.3f}", f"{np.median(cm):.2f}",
        f"{np.quantile(deg, 0.95):.3f}", f"{np.quantile(cm, 0.95):.2f}",
        f"{np.median(values['error_sigmas']):.1f}",
    )  # fmt: skip


def main() -> None:
    """Run scenarios."""
    parser = parser_of(__doc__)
    parser.add_argument("scenario", nargs="*", default=list(SCENARIOS), help=", ".join(SCENARIOS))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--picture", type=Path, help="draw data/track.png instead")
    options = parser.parse_args()
    if options.picture is not None:
        draw_picture(options.picture)
        return
    seeds, rows = range(options.runs), []
    for name in options.scenario:
        start = time.perf_counter()
        with ProcessPoolExecutor(options.jobs) as pool:
            outcomes = list(pool.map(SCENARIOS[name], seeds))
        rows.append(cells(name, outcomes))
        print(f"{', '.join(rows[-1])}; {time.perf_counter() - start:.0f} s", flush=True)
    table = Table("Simulated drives", COLUMNS, tuple(rows))
    publish([table])


if __name__ == "__main__":
    main()
