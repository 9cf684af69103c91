"""Solve time: ours against the paper's solver (SciPy) and against separate GTSAM factors.

    python -m benchmarks.speed.solve [--frames 10 100 1000] [--cameras 2 6 12] [--longest-s 300]

All minimize the same objective (paper, Eq. 5: Cauchy on the reprojection error, both priors, the
relative one over each camera with the next) from the same start, on simulated correspondences: N
frames, 1000 matches each in every camera, 15 % outliers; a stereo pair, or a ring of cameras. Ours
and SciPy's TRF run both passes: fit, drop what lies beyond the gate, fit again. What is dropped is
the same for both. One function evaluates all costs. A solver is not run if it would take longer
than --longest-s, extrapolated from smaller problems, or if its Jacobian would not fit.

CPU: processor time of all threads, to which other load adds little; the ratios are of this. Ours is
the shortest of several runs.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from benchmarks.speed.solvers import (
    Passes,
    Problem,
    solve_gtsam_cpp,
    solve_gtsam_python,
    solve_ours,
    solve_ours_once,
    solve_trf,
)
from benchmarks.tables import Table, add_record_option, publish

JACOBIAN_BYTES = 3e9  # of TRF, which keeps a few of them
FACTORS = 600_000  # more separate factors than these take gigabytes
PYTHON_FACTORS = 60_000
WARM_UP = (1, 2)  # frames and cameras of the solve that compiles


@dataclass(frozen=True)
class Timed:
    """One solver on one problem.

    Attributes:
        frames, cameras, correspondences: of the problem.
        solver: its name.
        wall_s, cpu_s: shortest of several runs.
        ratio: of processor time to ours, of as many passes.
        cost_1: the objective after the first pass.
        cost_2: after the second, over the correspondences within the gate; None without one.
    """

    frames: int
    cameras: int
    correspondences: int
    solver: str
    wall_s: float
    cpu_s: float
    ratio: float
    cost_1: float
    cost_2: float | None

    def cells(self) -> tuple[str, ...]:
        """The row of the table."""
        return (
            self.solver, str(self.frames), str(self.cameras), str(self.correspondences),
            f"{self.wall_s:.4f}", f"{self.cpu_s:.4f}", f"{self.ratio:.1f}", f"{self.cost_1:.4f}",
            "" if self.cost_2 is None else f"{self.cost_2:.4f}",
        )  # fmt: skip


COLUMNS = (
    "solver", "frames", "cameras", "correspondences", "wall [s]", "CPU [s]", "CPU ratio to ours",
    "cost, pass 1", "cost, pass 2",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A problem, and the same without its outliers."""

    size: tuple[int, int, int]
    problem: Problem
    inliers: Problem

    @staticmethod
    def draw(frames: int, cameras: int) -> Case:
        """The problem of a size."""
        problem = Problem.draw(frames, cameras)
        inliers = problem.without_outliers(solve_ours(problem).first)
        return Case((frames, cameras, len(problem.table)), problem, inliers)


@dataclass
class Bench:
    """All runs so far, to extrapolate how long the next would take."""

    longest_s: float
    rows: list[Timed] = field(default_factory=list)

    def compare(self, frames: int, cameras: int) -> None:
        """Time every solver on one problem."""
        case = Case.draw(frames, cameras)
        problem, (_, _, count) = case.problem, case.size
        repeats = int(np.clip(4e6 / count, 3, 30))
        base = {
            2: self._time("calibgraph", lambda: solve_ours(problem), case, repeats=repeats),
            1: self._time("calibgraph, pass 1", lambda: solve_ours_once(problem), case,
                          repeats=repeats),
        }  # fmt: skip
        others: list[tuple[str, Callable[[], Passes], int, bool]] = [
            ("SciPy TRF", lambda: solve_trf(problem, case.inliers), 2,
             16 * count * 6 * cameras < JACOBIAN_BYTES),  # two rows per correspondence
            ("GTSAM, C++ factor each, pass 1", lambda: solve_gtsam_cpp(problem), 1,
             count <= FACTORS),
            ("GTSAM, Python factor each, pass 1", lambda: solve_gtsam_python(problem), 1,
             count <= PYTHON_FACTORS),
        ]  # fmt: skip
        for solver, run, passes, fits in others:
            expected = self._expected(solver, case.size)
            if fits and expected < self.longest_s:
                self._time(solver, run, case, base_cpu_s=base[passes])
            else:
                why = f"would take about {expected:.0f} s" if fits else "too large"
                print(f"{solver}, {frames} frames, {cameras} cameras: not run, {why}", flush=True)

    def _expected(self, solver: str, size: tuple[int, int, int]) -> float:
        """Seconds that a solver would take, from its largest problem so far."""
        done = [(_work(solver, (r.frames, r.cameras, r.correspondences)), r.wall_s)
                for r in self.rows if r.solver == solver]  # fmt: skip
        work, seconds = max(done, default=(1, 0.0))
        return seconds * _work(solver, size) / work

    def _time(
        self,
        solver: str,
        run: Callable[[], Passes],
        case: Case,
        *,
        base_cpu_s: float | None = None,
        repeats: int = 1,
    ) -> float:
        """Run, print and keep; returns the processor time."""
        wall_s, cpu_s = np.inf, np.inf
        for _ in range(repeats):
            wall, cpu = time.perf_counter(), time.process_time()
            found = run()
            wall_s = min(wall_s, time.perf_counter() - wall)
            cpu_s = min(cpu_s, time.process_time() - cpu)
        second = None if found.second is None else case.inliers.cost(found.second)
        ratio = cpu_s / (base_cpu_s or cpu_s)
        cost = case.problem.cost(found.first)
        self.rows.append(Timed(*case.size, solver, wall_s, cpu_s, ratio, cost, second))
        print(", ".join(self.rows[-1].cells()), flush=True)
        return cpu_s


def _work(solver: str, size: tuple[int, int, int]) -> int:
    """What a solver's time is proportional to; TRF's Jacobian also grows with the cameras."""
    return size[2] * size[1] if "TRF" in solver else size[2]


def main() -> None:
    """Time all solvers on problems of all sizes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--cameras", type=int, nargs="+", default=[2, 6, 12])
    parser.add_argument("--longest-s", type=float, default=300.0)
    add_record_option(parser)
    options = parser.parse_args()
    solve_ours(Problem.draw(*WARM_UP))
    bench = Bench(options.longest_s)
    for cameras in options.cameras:
        for frames in options.frames:
            bench.compare(frames, cameras)
    table = Table("Solves of one objective", COLUMNS, tuple(row.cells() for row in bench.rows))
    publish("speed.solve", [table], record=options.record)


if __name__ == "__main__":
    main()
