"""Solve time: ours against SciPy (the paper's solver), Ceres, and separate GTSAM factors.

    python -m benchmarks.speed.solve [--frames 10 100 1000] [--cameras 2 12] [--matches 1000]
        [--longest-s 300]

Simulated correspondences: N frames with the given matches per camera, 15 % outliers; a stereo
pair, or a ring of cameras. The column "what":

* whole call: `calibgraph.solve(rig, table)` as users call it, with its defaults: preprocessing,
  Stage 1, frame weights, both passes, error bars and all checks. Its objective is its own, with
  scales from the data, so it has no cost here.
* 2 passes, pass 1: only the minimization of one objective (paper, Eq. 5: Cauchy on the reprojection
  error, both priors, the relative one over each camera with the next) from one start, with what it
  takes to build the problem: fit; drop what lies beyond the gate; fit again. What is dropped is the
  same for all. One function evaluates all costs.

Ceres: C++, automatic differentiation, dense Cholesky, one thread; left out where libceres-dev is
not installed. GTSAM: a factor per correspondence. A solver is not run if it would take longer than
--longest-s, extrapolated from smaller problems, or if its memory would not fit.

CPU: processor time of all threads, to which other load adds little; the ratios are of this: to ours
of as many passes, and to our whole call. Ours is the shortest of several runs.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.speed.ceres import CeresRun, compile_program, solve_ceres, why_not
from benchmarks.speed.solvers import (
    MATCHES,
    Passes,
    Problem,
    Transforms,
    solve_gtsam_cpp,
    solve_gtsam_python,
    solve_ours,
    solve_ours_once,
    solve_trf,
    solve_trf_once,
)
from benchmarks.tables import Table, parser_of, publish
from calibgraph import solve

JACOBIAN_BYTES = 3e9  # of TRF, which keeps a few of them
CERES_ROWS = 4_000_000  # of a few hundred bytes each
FACTORS = 600_000  # more separate factors than these take gigabytes
PYTHON_FACTORS = 60_000
WARM_UP = (10, 2)  # frames and cameras of the solve that compiles
CALL, BOTH, FIRST = "whole call", "2 passes", "pass 1"
COLUMNS = (
    "solver", "what", "frames", "cameras", "correspondences", "wall [s]", "CPU [s]",
    "CPU ratio to ours", "to our whole call", "cost, pass 1", "cost, pass 2",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Solver:
    """An implementation.

    Attributes:
        name: in the table.
        what: ``whole call``, ``2 passes`` or ``pass 1``.
        run: returns what it found, nothing for a whole call; with its own times for Ceres.
        fits: whether its memory does.
        repeats: the shortest of so many runs counts.
    """

    name: str
    what: str
    run: Callable[[], Passes | CeresRun | None]
    fits: bool = True
    repeats: int = 1

    def timed(self) -> tuple[Passes | None, float, float]:
        """What it found, wall and processor seconds."""
        wall, cpu = time.perf_counter(), time.process_time()
        found = self.run()
        if isinstance(found, CeresRun):
            return found.passes, found.wall_s, found.cpu_s
        return found, time.perf_counter() - wall, time.process_time() - cpu


def solvers(problem: Problem, inliers: Problem, gate_at: Transforms, ceres: Path | None
            ) -> Iterator[Solver]:  # fmt: skip
    """All implementations, ours first."""
    cameras, count = len(problem.rows), len(problem.table)
    jacobian_fits = 16 * count * 6 * cameras < JACOBIAN_BYTES  # two rows per correspondence
    many = int(np.clip(4e6 / count, 3, 30))
    yield Solver("calibgraph", CALL, partial(_solve_as_called, problem), repeats=3)
    yield Solver("calibgraph", BOTH, partial(solve_ours, problem), repeats=many)
    yield Solver("calibgraph", FIRST, partial(solve_ours_once, problem), repeats=many)
    yield Solver("SciPy TRF", BOTH, partial(solve_trf, problem, inliers), jacobian_fits)
    yield Solver("SciPy TRF", FIRST, partial(solve_trf_once, problem), jacobian_fits)
    if ceres is not None:
        run = partial(solve_ceres, ceres, problem, gate_at)
        yield Solver("Ceres", BOTH, run, count <= CERES_ROWS)
    run_cpp, run_python = (partial(f, problem) for f in (solve_gtsam_cpp, solve_gtsam_python))
    yield Solver("GTSAM, C++ factor each", FIRST, run_cpp, count <= FACTORS)
    yield Solver("GTSAM, Python factor each", FIRST, run_python, count <= PYTHON_FACTORS)


def _solve_as_called(problem: Problem) -> None:
    solve(problem.rig, problem.table)


Done = dict[tuple[str, str], tuple[float, float]]
"""By solver and what: the work of its largest problem so far, and its wall time."""


def compare(size: tuple[int, int, int], ceres: Path | None, longest_s: float, done: Done
            ) -> Iterator[tuple[str, ...]]:  # fmt: skip
    """Time every solver on a problem of so many frames, cameras and matches: a row each."""
    problem = Problem.draw(*size)
    ours = solve_ours(problem)
    inliers = problem.without_outliers(ours.first)
    base: dict[str, float] = {}
    for solver in solvers(problem, inliers, ours.first, ceres):
        key, count = (solver.name, solver.what), len(problem.table)
        work = count * (size[1] if "TRF" in solver.name else 1)  # its Jacobian grows with cameras
        before, seconds = done.get(key, (1.0, 0.0))
        expected = seconds * work / before
        if not solver.fits or expected >= longest_s:
            why = f"would take about {expected:.0f} s" if solver.fits else "too large"
            where = f"{size[0]} frames, {size[1]} cameras"
            print(f"{solver.name}, {solver.what}, {where}: not run, {why}", flush=True)
            continue
        wall_s, cpu_s, found = np.inf, np.inf, None
        for _ in range(solver.repeats):
            found, wall, cpu = solver.timed()
            wall_s, cpu_s = min(wall_s, wall), min(cpu_s, cpu)
        done[key] = max(done.get(key, (0.0, 0.0)), (work, wall_s))
        ratio, to_call = cpu_s / base.setdefault(solver.what, cpu_s), cpu_s / base.get(CALL, np.nan)
        costs = [] if found is None else [problem.cost(found.first)]
        costs += [inliers.cost(found.second)] if found is not None and found.second else []
        row = (
            *key, str(size[0]), str(size[1]), str(count), f"{wall_s:.4f}", f"{cpu_s:.4f}",
            f"{ratio:.1f}", f"{to_call:.2f}", *([f"{cost:.4f}" for cost in costs] + ["", ""])[:2],
        )  # fmt: skip
        print(", ".join(row), flush=True)
        yield row


def main() -> None:
    """Time all solvers on problems of all sizes."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--cameras", type=int, nargs="+", default=[2, 12])
    parser.add_argument("--matches", type=int, default=MATCHES)
    parser.add_argument("--longest-s", type=float, default=300.0)
    options = parser.parse_args()
    warm_up = Problem.draw(*WARM_UP)
    solve_ours(warm_up)
    _solve_as_called(warm_up)
    with tempfile.TemporaryDirectory() as folder:
        missing = why_not()
        if missing:
            print(f"Ceres: left out, {missing}", flush=True)
        ceres, done = None if missing else compile_program(Path(folder)), Done()
        rows = [
            row
            for cameras, frames in product(options.cameras, options.frames)
            for row in compare((frames, cameras, options.matches), ceres, options.longest_s, done)
        ]
    table = Table("Solves of one objective", COLUMNS, tuple(rows))
    publish("speed.solve", [table], record=options.record)


if __name__ == "__main__":
    main()
