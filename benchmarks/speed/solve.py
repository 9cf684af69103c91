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
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.speed.ceres import compile_program, solve_ceres, why_not
from benchmarks.speed.solvers import (
    MATCHES,
    Passes,
    Problem,
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


@dataclass(frozen=True, eq=False)
class Solver:
    """An implementation.

    Attributes:
        name: in the table.
        what: ``whole call``, ``2 passes`` or ``pass 1``.
        run: returns what it found (None for a whole call), wall and processor seconds.
        fits: whether its memory does.
    """

    name: str
    what: str
    run: Callable[[], tuple[Passes | None, float, float]]
    fits: bool = True


@dataclass(frozen=True)
class Timed:
    """One solver on one problem.

    Attributes:
        solver, what: which.
        frames, cameras, correspondences: of the problem.
        wall_s, cpu_s: shortest of several runs.
        ratio: of processor time to ours, of as many passes.
        ratio_to_call: to our whole call.
        cost_1: the objective after the first pass; None for a whole call.
        cost_2: after the second, over the correspondences within the gate; None without one.
    """

    solver: str
    what: str
    frames: int
    cameras: int
    correspondences: int
    wall_s: float
    cpu_s: float
    ratio: float
    ratio_to_call: float
    cost_1: float | None = None
    cost_2: float | None = None

    def cells(self) -> tuple[str, ...]:
        """The row of the table."""
        costs = ("" if cost is None else f"{cost:.4f}" for cost in (self.cost_1, self.cost_2))
        return (
            self.solver, self.what, str(self.frames), str(self.cameras), str(self.correspondences),
            f"{self.wall_s:.4f}", f"{self.cpu_s:.4f}", f"{self.ratio:.1f}",
            f"{self.ratio_to_call:.2f}", *costs,
        )  # fmt: skip


COLUMNS = (
    "solver", "what", "frames", "cameras", "correspondences", "wall [s]", "CPU [s]",
    "CPU ratio to ours", "to our whole call", "cost, pass 1", "cost, pass 2",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A problem, our solution of it, and the problem without its outliers."""

    size: tuple[int, int, int]
    problem: Problem
    ours: Passes
    inliers: Problem

    @staticmethod
    def draw(frames: int, cameras: int, matches: int) -> Case:
        """The problem of a size."""
        problem = Problem.draw(frames, cameras, matches)
        ours = solve_ours(problem)
        inliers = problem.without_outliers(ours.first)
        return Case((frames, cameras, len(problem.table)), problem, ours, inliers)

    def solvers(self, ceres: Path | None) -> list[Solver]:
        """All implementations, ours first."""
        problem, (_, cameras, count) = self.problem, self.size
        jacobian_fits = 16 * count * 6 * cameras < JACOBIAN_BYTES  # two rows per correspondence
        trf = partial(solve_trf, problem, self.inliers)
        found = [
            Solver("calibgraph", CALL, timed(partial(_solve_as_called, problem))),
            Solver("calibgraph", BOTH, timed(partial(solve_ours, problem))),
            Solver("calibgraph", FIRST, timed(partial(solve_ours_once, problem))),
            Solver("SciPy TRF", BOTH, timed(trf), jacobian_fits),
            Solver("SciPy TRF", FIRST, timed(partial(solve_trf_once, problem)), jacobian_fits),
        ]
        if ceres is not None:
            found.append(Solver("Ceres", BOTH, partial(self._run_ceres, ceres),
                                count <= CERES_ROWS))  # fmt: skip
        for name, run, most in (
            ("GTSAM, C++ factor each", solve_gtsam_cpp, FACTORS),
            ("GTSAM, Python factor each", solve_gtsam_python, PYTHON_FACTORS),
        ):
            found.append(Solver(name, FIRST, timed(partial(run, problem)), count <= most))
        return found

    def _run_ceres(self, program: Path) -> tuple[Passes, float, float]:
        run = solve_ceres(program, self.problem, self.ours.first)
        return run.passes, run.wall_s, run.cpu_s


def _solve_as_called(problem: Problem) -> None:
    solve(problem.rig, problem.table)


def timed(
    run: Callable[[], Passes | None],
) -> Callable[[], tuple[Passes | None, float, float]]:
    """A function that also returns wall and processor seconds."""

    def run_timed() -> tuple[Passes | None, float, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        found = run()
        return found, time.perf_counter() - wall, time.process_time() - cpu

    return run_timed


@dataclass
class Bench:
    """All runs so far, to extrapolate how long the next would take."""

    longest_s: float
    ceres: Path | None
    rows: list[Timed] = field(default_factory=list)

    def compare(self, frames: int, cameras: int, matches: int) -> None:
        """Time every solver on one problem."""
        case = Case.draw(frames, cameras, matches)
        base: dict[str, float] = {}
        for solver in case.solvers(self.ceres):
            expected = self._expected(solver, case.size)
            if solver.fits and expected < self.longest_s:
                self._time(solver, case, base)
            else:
                why = f"would take about {expected:.0f} s" if solver.fits else "too large"
                size = f"{frames} frames, {cameras} cameras"
                print(f"{solver.name}, {solver.what}, {size}: not run, {why}", flush=True)

    def _expected(self, solver: Solver, size: tuple[int, int, int]) -> float:
        """Seconds that a solver would take, from its largest problem so far."""
        done = [(_work(solver.name, (r.frames, r.cameras, r.correspondences)), r.wall_s)
                for r in self.rows if (r.solver, r.what) == (solver.name, solver.what)]  # fmt: skip
        work, seconds = max(done, default=(1, 0.0))
        return seconds * _work(solver.name, size) / work

    def _time(self, solver: Solver, case: Case, base: dict[str, float]) -> None:
        """Run, print and keep; our times go into ``base``, by what."""
        wall_s, cpu_s = np.inf, np.inf
        for _ in range(_repeats(solver, case.size[2])):
            found, wall, cpu = solver.run()
            wall_s, cpu_s = min(wall_s, wall), min(cpu_s, cpu)
        ours = base.setdefault(solver.what, cpu_s)
        first = None if found is None else case.problem.cost(found.first)
        second = None if found is None or found.second is None else case.inliers.cost(found.second)
        ratios = cpu_s / ours, cpu_s / base.get(CALL, np.nan)
        row = Timed(solver.name, solver.what, *case.size, wall_s, cpu_s, *ratios, first, second)
        self.rows.append(row)
        print(", ".join(row.cells()), flush=True)


def _repeats(solver: Solver, count: int) -> int:
    if solver.name != "calibgraph":
        return 1
    return 3 if solver.what == CALL else int(np.clip(4e6 / count, 3, 30))


def _work(solver: str, size: tuple[int, int, int]) -> int:
    """What a solver's time is proportional to; TRF's Jacobian also grows with the cameras."""
    return size[2] * size[1] if "TRF" in solver else size[2]


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
        bench = Bench(options.longest_s, None if missing else compile_program(Path(folder)))
        for cameras in options.cameras:
            for frames in options.frames:
                bench.compare(frames, cameras, options.matches)
    table = Table("Solves of one objective", COLUMNS, tuple(row.cells() for row in bench.rows))
    publish("speed.solve", [table], record=options.record)


if __name__ == "__main__":
    main()
