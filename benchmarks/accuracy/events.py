"""What the tracker detects: simulated drives in which something moves, or nothing does.

    python -m benchmarks.accuracy.events --runs 100 --jobs 2 [scenario ...]
    python -m benchmarks.accuracy.events --picture data/track.png

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

import numpy as np

from benchmarks.accuracy.drives import (
    ERRORS,
    MATCHES,
    NAMES,
    RIG,
    draw_picture,
    move_camera,
    move_lidar,
    random_step,
)
from benchmarks.tables import Table, parser_of, publish
from calibgraph import IncrementalCalibrator, Rig, perturb
from calibgraph.model.geometry import twist_between
from tests.draws.drives import simulate_drive


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
        reports: all events that were reported, in words.
    """

    detected: bool
    attributed: bool
    delay: float
    false_alarms: int
    frames: int
    error_deg: float
    error_cm: float
    error_sigmas: float
    reports: tuple[str, ...]


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


def compare(
    events: list, errors: dict, frames: int, *, at: int, kind: str, who: str | None
) -> Outcome:
    """Compare the reports with what happened."""
    after = [e for e in events if e.detected_frame >= at and e.kind in (kind, "drifts", "moved")]
    right = [e for e in after if e.camera == who]
    return Outcome(
        detected=bool(after),
        attributed=bool(after) and all(e.camera == who for e in after),
        delay=right[0].detected_frame - at if right else np.nan,
        false_alarms=len(events) - min(len(right), 1),
        frames=frames,
        **errors,
        reports=tuple(f"{e.kind} {e.camera} {e.frame}->{e.detected_frame}" for e in events),
    )


def nothing(seed: int, frames: int = 1000) -> Outcome:
    """Nothing moves."""
    events, errors = drive(lambda frame: RIG, frames, seed)
    reports = tuple(f"{e.kind} {e.camera} {e.detected_frame}" for e in events)
    return Outcome(not events, not events, np.nan, len(events), frames, **errors, reports=reports)


def step_of_camera(seed: int, failed_share: float = 0.0) -> Outcome:
    """One camera moves by 0.3 deg and 2 cm."""
    rng = np.random.default_rng(seed + 1_000_000)
    who, at, step = str(rng.choice(NAMES)), int(rng.integers(100, 200)), random_step(rng, 0.3, 2)
    after = move_camera(RIG, who, step)
    frames = at + 150
    events, errors = drive(
        lambda frame: after if frame >= at else RIG, frames, seed, failed_share=failed_share
    )
    return compare(events, errors, frames, at=at, kind="moved", who=who)


def step_of_lidar(seed: int) -> Outcome:
    """The LiDAR moves by 0.3 deg and 2 cm."""
    rng = np.random.default_rng(seed + 1_000_000)
    at, step = int(rng.integers(100, 200)), random_step(rng, 0.3, 2)
    after = move_lidar(RIG, step)
    events, errors = drive(lambda frame: after if frame >= at else RIG, at + 150, seed)
    return compare(events, errors, at + 150, at=at, kind="moved", who=None)


def slow_drift(seed: int) -> Outcome:
    """One camera turns by 0.5 deg in 5000 frames, after 200 without motion."""
    rng = np.random.default_rng(seed + 1_000_000)
    who, step = str(rng.choice(NAMES)), random_step(rng, 0.5, 0)

    def rig_at(frame: int) -> Rig:
        return move_camera(RIG, who, step * max(0, frame - 200) / 5000)

    events, errors = drive(rig_at, 5200, seed)
    return compare(events, errors, 5200, at=200, kind="drifts", who=who)


def slow_drift_of_lidar(seed: int) -> Outcome:
    """The LiDAR turns by 0.5 deg in 5000 frames, after 200 without motion."""
    rng = np.random.default_rng(seed + 1_000_000)
    step = random_step(rng, 0.5, 0)

    def rig_at(frame: int) -> Rig:
        return move_lidar(RIG, step * max(0, frame - 200) / 5000)

    events, errors = drive(rig_at, 2200, seed)
    return compare(events, errors, 2200, at=200, kind="drifts", who=None)


def garbage(seed: int) -> Outcome:
    """30 % of the frames have wrong matches; nothing moves."""
    events, errors = drive(lambda frame: RIG, 500, seed, failed_share=0.3)
    reports = tuple(f"{e.kind} {e.camera} {e.detected_frame}" for e in events)
    return Outcome(not events, not events, np.nan, len(events), 500, **errors, reports=reports)


def blind(seed: int) -> Outcome:
    """A camera sees nothing for 500 frames, then again."""
    rng = np.random.default_rng(seed + 1_000_000)
    who, at = str(rng.choice(NAMES)), int(rng.integers(100, 200))
    frames = at + 650
    hidden = {who: range(at, at + 500)}
    events, errors = drive(lambda frame: RIG, frames, seed, blind=hidden)
    return compare(events, errors, frames, at=at, kind="blind", who=who)


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


COLUMNS = (
    "drive", "runs", "detected", "rightly named", "frames until reported: median", "longest",
    "false alarms", "frames in all", "error after: median [deg]", "[cm]", "95 % [deg]", "[cm]",
    "largest component, median [sigma]",
)  # fmt: skip


def cells(name: str, outcomes: list[Outcome]) -> tuple[str, ...]:
    """The row of a scenario."""

    def values(column: str) -> np.ndarray:
        return np.array([getattr(outcome, column) for outcome in outcomes], dtype=float)

    delays = values("delay")[~np.isnan(values("delay"))]
    deg, cm = values("error_deg"), values("error_cm")
    return (
        name, str(len(outcomes)), f"{values('detected').mean():.0%}",
        f"{values('attributed').mean():.0%}", f"{np.median(delays):.0f}" if len(delays) else "",
        f"{delays.max():.0f}" if len(delays) else "", f"{values('false_alarms').sum():.0f}",
        f"{values('frames').sum():.0f}", f"{np.median(deg):.3f}", f"{np.median(cm):.2f}",
        f"{np.quantile(deg, 0.95):.3f}", f"{np.quantile(cm, 0.95):.2f}",
        f"{np.median(values('error_sigmas')):.1f}",
    )  # fmt: skip


def main() -> None:
    """Run scenarios."""
    options = parse_options()
    if options.picture is not None:
        draw_picture(options.picture)
        return
    seeds, rows = range(options.first, options.first + options.runs), []
    for name in options.scenario:
        start = time.perf_counter()
        with ProcessPoolExecutor(options.jobs) as pool:
            outcomes = list(pool.map(SCENARIOS[name], seeds))
        rows.append(cells(name, outcomes))
        print(f"{', '.join(rows[-1])}; {time.perf_counter() - start:.0f} s", flush=True)
        if options.verbose:
            for seed, outcome in zip(seeds, outcomes, strict=True):
                if not outcome.attributed or outcome.false_alarms:
                    print("   ", seed, outcome.reports, outcome.delay)
    table = Table("Simulated drives", COLUMNS, tuple(rows))
    publish("accuracy.events", [table], record=options.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = parser_of(__doc__)
    parser.add_argument("scenario", nargs="*", default=list(SCENARIOS), help=", ".join(SCENARIOS))
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--verbose", action="store_true", help="print the reports of wrong runs")
    parser.add_argument("--picture", type=Path, help="draw data/track.png instead")
    return parser.parse_args()


if __name__ == "__main__":
    main()
