"""Processor time as ratios against well-known baselines, all of one run; fails if one has grown.

    python -m benchmarks.speed.gate --against FILE    fail where one is over 1.25 times that of FILE
    python -m benchmarks.speed.gate --write           keep them as those of this release

A ratio is the median over pairs of a call and its baseline, which run one after the other on one
thread: so slower machines change it little, and other load, which both meet, less than times. What
fails is measured again, by itself. Baselines: a matrix product (sgemm, 1024 rows), SciPy's TRF, a
GTSAM factor per correspondence, a copy of memory as large as the table.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median

import gtsam
import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.baselines import minimize_trf, prior_rows
from benchmarks.speed.incremental import GUESS, frames
from benchmarks.tables import ROOT, Table, parser_of
from calibgraph import (
    Correspondences,
    IncrementalCalibrator,
    MatcherErrors,
    Rig,
    calibrate,
    load_correspondences,
    load_dataset,
    perturb,
    preset,
    simulate_correspondences,
    solve,
)
from calibgraph.graph.objective import objective_graph, pose_key
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.parallel import THREADS_VARIABLE
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.matches import camera_blocks
from calibgraph.solver.two_pass import Objective, to_values
from calibgraph.tracking import warm_up_tracker
from factors import projection_factor

RELEASE = ROOT / "benchmarks" / "ratios.json"
SAMPLE = ROOT / "data" / "sample"
WORST = 1.25
_TRIES = 3  # of a ratio that fails
MATRIX = 1024  # rows of the square matrices
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_ENVIRONMENT = {**ONE_THREAD, "NUMBA_NUM_THREADS": "1", THREADS_VARIABLE: "1"}
_FRAMES, _CAMERAS = 2, 2  # of the sample, that are calibrated
_UPDATES = 40  # of a tracker

Array = NDArray[np.float64]
Transforms = dict[str, Array]
"""Per camera, (4, 4) T_camera_lidar."""
Ratios = dict[str, float]
Run = Callable[[], object]

CONFIG = preset("kitti").changed(stage1="rig")
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.15)
SCALE_PX = 4.0  # the preset's
MATCHES = 1000


@dataclass(frozen=True, eq=False)
class Pair:
    """A call and its baseline.

    Attributes:
        name: of the ratio.
        run, baseline: each is run many times at a stroke, so that both take long enough to time.
        pairs: how many; the first also warms up.
        unit: what the ratio of their times is divided by.
    """

    name: str
    run: Run
    baseline: Run
    pairs: int = 3
    unit: float = 1.0

    def ratio(self) -> float:
        """The median over the pairs."""
        found = [_seconds(self.run) / _seconds(self.baseline) for _ in range(self.pairs)]
        return median(found) / self.unit


def main() -> int:
    """Measure, print, write, compare."""
    parser = parser_of(__doc__)
    parser.add_argument("--against", type=Path, help="ratios of a release")
    parser.add_argument("--write", action="store_true", help=f"to {RELEASE.relative_to(ROOT)}")
    options = parser.parse_args()
    if not _ENVIRONMENT.items() <= os.environ.items():
        command = [sys.executable, "-m", __spec__.name, *sys.argv[1:]]
        os.execve(sys.executable, command, {**os.environ, **_ENVIRONMENT})
    former = json.loads(options.against.read_text("utf-8")) if options.against else {}
    with tempfile.TemporaryDirectory() as folder:
        found = {pair.name: measure(pair, former) for pair in all_pairs(Path(folder))}
    if options.write:
        RELEASE.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(compare(found, former).text())
    worse = slower(found, former)
    for name in worse:
        print(f"{name}: {found[name]:.3g} is over {WORST} times {former[name]:.3g}")
    return 1 if worse else 0


def measure(pair: Pair, former: Ratios) -> float:
    """A ratio: smaller is faster. One that fails is measured again, and the smallest counts."""
    found = pair.ratio()
    for _ in range(_TRIES - 1):
        if slower({pair.name: found}, former):
            found = min(found, pair.ratio())
    return found


def all_pairs(folder: Path) -> Iterator[Pair]:
    """All that is measured, each put together when it is its turn.

    Args:
        folder: for a table.
    """
    small, large = Problem.draw(10), Problem.draw(100)
    yield solve_of(small, "2 x 10 x 1000", times=2, pairs=9)
    yield solve_of(large, "2 x 100 x 1000", times=3, pairs=3)
    yield one_pass(Problem.draw(3))
    yield update(small)
    yield reading(large, folder / "correspondences.parquet")
    yield whole()


@dataclass(frozen=True, eq=False)
class Problem:
    """A table and the start.

    Attributes:
        rig: lenses and the start, which is also T_hat.
        table: all correspondences.
        rows: per camera, those that the cost sums over.
    """

    rig: Rig
    table: Correspondences
    rows: dict[str, Correspondences]

    @staticmethod
    def draw(frames: int) -> Problem:
        """A stereo pair; the start is 0.5 deg and 5 cm off."""
        rig = rig_of("kitti")
        table = simulate_correspondences(rig, frames=frames, matches=MATCHES, errors=ERRORS)
        guess = perturb(rig, rotation_deg=0.5, translation_m=0.05)
        return Problem(guess, table, {name: table.of_camera(name) for name in rig.cameras})

    @property
    def T_hat(self) -> Transforms:
        """The start, to which the priors pull."""
        return self.rig.T_camera_lidar

    def residuals(self, name: str, T: Array) -> Array:
        """(n, 2) residuals of a camera, as the paper's Python would compute them."""
        lens, rows = self.rig.cameras[name].intrinsics_px, self.rows[name]
        p = rows.points_lidar_m @ T[:3, :3].T + T[:3, 3]
        u, v = lens.fx * p[:, 0] / p[:, 2] + lens.cx, lens.fy * p[:, 1] / p[:, 2] + lens.cy
        return np.stack([u, v], 1) - rows.pixels_px


def solve_ours_once(problem: Problem) -> Transforms:
    """The first pass of calibgraph; the time includes building the graph."""
    blocks = camera_blocks(problem.rig, problem.table, CONFIG)
    objective = Objective(problem.rig, blocks, problem.T_hat, CONFIG, "full")
    return objective.minimize_with_scale(problem.T_hat)[0]


def solve_trf_once(problem: Problem) -> Transforms:
    """The first pass of the paper's solver, as its comparison runs it."""

    def residuals(T: Transforms) -> Array:
        return np.concatenate([problem.residuals(name, T[name]) for name in problem.rows])

    def priors(T: Transforms) -> Array:
        return prior_rows(T, problem.T_hat, CONFIG)

    return minimize_trf(residuals, priors, problem.T_hat, scale_px=SCALE_PX)


def solve_gtsam_python(problem: Problem) -> Transforms:
    """The first pass with one Python factor per correspondence."""
    names, T_hat = list(problem.rows), problem.T_hat
    graph = objective_graph(problem.rig, {}, T_hat, CONFIG, terms="full")
    for name, rows in problem.rows.items():
        key, lens = pose_key(names, name), problem.rig.cameras[name].lens
        for point, pixel in zip(rows.points_lidar_m, rows.pixels_px, strict=True):
            graph.add(projection_factor(key, lens, point, pixel, scale=SCALE_PX))
    found = gtsam.LevenbergMarquardtOptimizer(graph, to_values(names, T_hat)).optimize()
    return {name: to_T_camera_lidar(found.atPose3(pose_key(names, name))) for name in names}


def solve_of(problem: Problem, size: str, *, times: int, pairs: int) -> Pair:
    """A whole call over one pass of TRF."""
    run = _repeated(partial(solve, problem.rig, problem.table), times)
    baseline = partial(solve_trf_once, problem)
    return Pair(f"solve / one pass of TRF, {size}", run, baseline, pairs, times)


def one_pass(problem: Problem) -> Pair:
    """One pass over one with a factor per correspondence."""
    times = 50
    run, baseline = partial(solve_ours_once, problem), partial(solve_gtsam_python, problem)
    name = "one pass / GTSAM, a factor per correspondence"
    return Pair(name, _repeated(run, times), baseline, unit=times)


def update(problem: Problem) -> Pair:
    """A tracker's frames over one pass of TRF, which like them is Python and small arrays."""
    warm_up_tracker()
    tables = list(frames(_UPDATES))

    def track() -> None:
        tracker = IncrementalCalibrator(GUESS)
        for table in tables:
            tracker.update(table)

    name, baseline = "update of two cameras / one pass of TRF", partial(solve_trf_once, problem)
    return Pair(name, track, baseline, 5, _UPDATES)


def reading(problem: Problem, path: Path) -> Pair:
    """A table from Parquet over a copy of its columns."""
    problem.table.save(path)
    columns = [problem.table.pixels_px, problem.table.points_lidar_m]

    def copy() -> None:
        for column in columns:
            column.copy()

    times, copies = 3, 100
    run = _repeated(partial(load_correspondences, path), times)
    name = "table from Parquet / copy of memory"
    return Pair(name, run, _repeated(copy, copies), 9, times / copies)


def whole() -> Pair:
    """`calibrate` of a part of the sample over a matrix product."""
    sample, times = load_dataset(SAMPLE), 20
    rig = Rig(cameras=dict(list(sample.rig.cameras.items())[:_CAMERAS]))
    part = replace(sample, rig=rig, frames=sample.frames[:_FRAMES])
    name = f"calibrate of {_CAMERAS} cameras, {_FRAMES} frames / sgemm"
    return Pair(name, partial(calibrate, part), _sgemm(times), unit=1 / times)


def _sgemm(times: int) -> Run:
    matrix = np.random.default_rng(0).random((MATRIX, MATRIX), np.float32)
    return _repeated(partial(np.matmul, matrix, matrix, np.empty_like(matrix)), times)


def _repeated(run: Run, times: int) -> Run:
    def repeat() -> None:
        for _ in range(times):
            run()

    return repeat


def _seconds(run: Run) -> float:
    """Processor seconds of a call."""
    start = time.process_time()
    run()
    return time.process_time() - start


def slower(found: Ratios, former: Ratios) -> list[str]:
    """The names of ratios over ``WORST`` times those of a release."""
    return [name for name in found if name in former and found[name] > WORST * former[name]]


def compare(found: Ratios, former: Ratios) -> Table:
    """A row per ratio."""
    rows = [
        (name, f"{value:.4g}", f"{value / former[name]:.2f}" if name in former else "")
        for name, value in found.items()
    ]
    return Table(
        "Processor time", ("ratio of processor times", "now", "over the release's"), tuple(rows)
    )


if __name__ == "__main__":
    sys.exit(main())
