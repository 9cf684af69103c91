"""Errors of the tracker, after drives along places, against the covariances it reports.

    python -m benchmarks.accuracy.tracked_places [--draws 200] [--cases circling ...]

Errors are drawn from the error model, 2 cameras. A vehicle stands, creeps,
drives on, or circles one block; each drive has 60 frames, which name their places. NEES is the
squared error in the metric of its covariance; its mean over 6 should be 1. Moves and drifts that
are reported are false: nothing moves.
"""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.uncertainty import calibration
from benchmarks.tables import Table, parser_of, publish
from calibgraph import Config, IncrementalCalibrator
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import relative_covariance, relative_transform, twist_between
from tests.draws.places import Drawn, draw_places

Array = NDArray[np.float64]

CASES = {
    "stands: 1 place": (1, 60, 1),
    "creeps: 3 places": (3, 20, 1),
    "drives: 20 places": (20, 3, 1),
    "circles: 5 places, 4 times": (5, 3, 4),
}
"""Per case: places, frames of a place in each round, rounds."""

COLUMNS = ("case", "error of", "mean NEES / 6", "in the 95 % region", "error [deg]", "[cm]",
           "false events")  # fmt: skip


def main() -> None:
    """Draw, track, and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--matches", type=int, default=100)
    parser.add_argument("--cases", nargs="+", default=[*CASES], choices=[*CASES])
    options = parser.parse_args()
    rows = [row for case in options.cases for row in rows_of(case, options.draws, options.matches)]
    title = f"{options.draws} draws, 60 frames, {options.matches} matches each"
    publish("accuracy.tracked_places", [Table(title, COLUMNS, tuple(rows))], record=options.record)


def rows_of(case: str, draws: int, matches: int) -> Iterator[tuple[str, ...]]:
    """Each camera and the pair."""
    places, frames, rounds = CASES[case]
    nees: dict[str, list[float]] = {}
    sizes: dict[str, list[Array]] = {}
    false_events = 0
    for seed in range(draws):
        rng = np.random.default_rng([18, seed])
        drawn = draw_places(places, matches, rng, frames=frames, rounds=rounds)
        result, events = tracked(drawn)
        false_events += events
        for of, error, covariance in errors_of(result, drawn):
            nees.setdefault(of, []).append(float(error @ np.linalg.solve(covariance, error)))
            size = np.linalg.norm(np.degrees(error[:3])), 100 * np.linalg.norm(error[3:])
            sizes.setdefault(of, []).append(np.array(size))
    for of, values in nees.items():
        deg, cm = np.median(sizes[of], axis=0)
        yield case, of, *calibration(values), f"{deg:.3f}", f"{cm:.2f}", str(false_events)


def tracked(drawn: Drawn) -> tuple[Calibration, int]:
    """The last estimate, and how many moves and drifts were reported."""
    tracker, events = IncrementalCalibrator(drawn.rig, Config(of="mount")), 0
    for frame in np.unique(drawn.table.frame):
        update = tracker.update(drawn.table.select(drawn.table.frame == frame))
        events += sum(event.kind in ("moved", "drifts") for event in update.events)
    return tracker.calibration(), events


def errors_of(result: Calibration, drawn: Drawn) -> Iterator[tuple[str, Array, Array]]:
    """Each camera and the pair: its error and covariance."""
    joint, T = result.joint_covariance, result.T_camera_lidar
    assert joint is not None
    truth = drawn.rig.T_camera_lidar
    errors = {name: twist_between(T[name], truth[name]) for name in T}
    for camera, (name, error) in enumerate(errors.items()):
        rows = slice(6 * camera, 6 * camera + 6)
        yield name, error, joint[rows, rows]
    (left, one), (right, other) = errors.items()
    T_right_left = relative_transform(T[right], T[left])
    apart = other - gtsam.Pose3(T_right_left).AdjointMap() @ one
    yield f"{left}->{right}", apart, relative_covariance(joint, 0, 1, T_right_left)


if __name__ == "__main__":
    main()
