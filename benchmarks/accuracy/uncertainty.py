"""Errors of many simulated draws against the reported covariances.

    python -m benchmarks.accuracy.uncertainty [--draws 200] [--matches 100]
    python -m benchmarks.accuracy.uncertainty --cases "stands: 1 place" ...

``batch``: ``solve`` on 30 frames of the simulated matcher, whose errors are 1 px independent, 1 px
shared by a camera's frame, and 15 % outliers. For comparison: (J^T J)^-1, the inverse of the
information of independent correspondences. The other cases are of the tracker, with errors drawn
from the error model: a vehicle stands, creeps, drives on, or circles one block; each drive has 60
frames, which name their places. Moves and drifts that it reports are false: nothing moves.

NEES is the squared error in the metric of its covariance; its mean over 6 should be 1. Of the
errors, 95 % should lie within the 95 % quantile of chi-squared with 6 degrees of freedom.
"""

from collections.abc import Iterator, Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.tables import Table, parser_of, publish
from calibgraph import Config, IncrementalCalibrator, MatcherErrors, Rig, simulate_correspondences
from calibgraph.model.geometry import (
    relative_covariance,
    relative_transform,
    to_T_lidar_camera,
    twist_between,
)
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Evidence
from tests.draws.places import draw_places, stereo

Array = NDArray[np.float64]
Error = tuple[str, str, Array, Array]
"""Of what, by which covariance, (6,) the error, (6, 6) the covariance."""

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
BATCH, FRAMES = "batch", 30
TRACKED = {
    "stands: 1 place": (1, 60, 1),
    "creeps: 3 places": (3, 20, 1),
    "drives: 20 places": (20, 3, 1),
    "circles: 5 places, 4 times": (5, 3, 4),
}
"""Per case of the tracker: places, frames of a place in each round, rounds."""


def main() -> None:
    """Draw, solve or track, and print one table."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--matches", type=int, default=100)
    names = [BATCH, *TRACKED]
    parser.add_argument("--cases", nargs="+", default=names, choices=names)
    options = parser.parse_args()
    rows = [row for case in options.cases for row in rows_of(case, options.draws, options.matches)]
    title = f"{options.draws} draws, {options.matches} matches of a camera in a frame"
    columns = ("case", "error of", "covariance", "mean NEES / 6", "in the 95 % region",
               "error [deg]", "[cm]", "false events")  # fmt: skip
    publish([Table(title, columns, tuple(rows))])


def rows_of(case: str, draws: int, matches: int) -> Iterator[tuple[str, ...]]:
    """Each camera and the pair, by each covariance."""
    found: dict[tuple[str, str], list[Array]] = {}
    false_events = 0
    for seed in range(draws):
        errors, events = solved(matches, seed) if case == BATCH else tracked(case, matches, seed)
        false_events += events
        for of, which, error, covariance in errors:
            nees = float(error @ np.linalg.solve(covariance, error))
            deg, cm = np.linalg.norm(np.degrees(error[:3])), 100 * np.linalg.norm(error[3:])
            found.setdefault((of, which), []).append(np.array([nees, deg, cm]))
    for name, values in found.items():
        nees, deg, cm = np.array(values).T
        sizes = f"{np.median(deg):.3f}", f"{np.median(cm):.2f}"
        yield case, *name, *calibration(nees), *sizes, str(false_events)


def calibration(nees: Sequence[float] | Array) -> tuple[str, str]:
    """Their mean over 6, and the share in the region that should hold 95 %."""
    inside = np.mean(np.array(nees) < chi2.ppf(0.95, 6))
    return f"{np.mean(nees) / 6:.2f}", f"{inside:.1%}"


def solved(matches: int, seed: int) -> tuple[list[Error], int]:
    """A batch by our covariance and by that of independent correspondences."""
    rig = stereo()
    table = simulate_correspondences(rig, frames=FRAMES, matches=matches, errors=ERRORS, seed=seed)
    solution = solve_joint(rig, table, Config())
    ours, T = Evidence(solution, rig).joint_covariance, solution.T_camera_lidar
    return [
        *errors_of(T, rig, ours, "by frames (ours)"),
        *errors_of(T, rig, independent(solution), "(J^T J)^-1"),
    ], 0


def tracked(case: str, matches: int, seed: int) -> tuple[list[Error], int]:
    """The last estimate of a drive, and how many moves and drifts were reported."""
    places, frames, rounds = TRACKED[case]
    rng = np.random.default_rng([18, seed])
    drawn = draw_places(places, matches, rng, frames=frames, rounds=rounds)
    tracker, events = IncrementalCalibrator(drawn.rig, Config(of="mount")), 0
    for frame in np.unique(drawn.table.frame):
        update = tracker.update(drawn.table.select(drawn.table.frame == frame))
        events += sum(event.kind in ("moved", "drifts") for event in update.events)
    result = tracker.calibration()
    joint = result.joint_covariance
    return [*errors_of(result.T_camera_lidar, drawn.rig, joint, "of the tracker")], events


def errors_of(
    T: Mapping[str, Array], truth: Rig, joint: Array | None, which: str
) -> Iterator[Error]:
    """Each of two cameras and the pair: its error and covariance."""
    assert joint is not None
    errors = [twist_between(T[name], truth.T_camera_lidar[name]) for name in T]
    for camera, name in enumerate(T):
        rows = slice(6 * camera, 6 * camera + 6)
        yield name, which, errors[camera], joint[rows, rows]
    left, right = T
    T_right_left = relative_transform(T[right], T[left])
    apart = errors[1] - gtsam.Pose3(T_right_left).AdjointMap() @ errors[0]
    yield f"{left}->{right}", which, apart, relative_covariance(joint, 0, 1, T_right_left)


def independent(solution: Solution) -> Array:
    """(12, 12) inverse of the information of all inliers, taken for independent."""
    joint = np.zeros((12, 12))
    for place, (name, matches) in enumerate(solution.inliers.blocks.items()):
        rows = slice(6 * place, 6 * place + 6)
        block = matches.with_scale(solution.scales[name])
        sums = block.sums(to_T_lidar_camera(solution.T_camera_lidar[name]))
        joint[rows, rows] = np.linalg.inv(sums.hessian)
    return joint


if __name__ == "__main__":
    main()
