"""The benchmarks of speed measure what they state."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from benchmarks.speed import ceres, gate
from benchmarks.speed.solvers import Problem, solve_ours
from benchmarks.speed.stages import STAGES, StageSampler

BUSY_S = 0.2  # of 5 ms between samples: 40 of them


def in_file(path: str, called: Callable[[], None]) -> Callable[[], None]:
    """A function of a file of that name, which calls another."""
    names = {"called": called}
    exec(compile("def function():\n    called()\n", path, "exec"), names)
    return names["function"]


def compute() -> None:
    end = time.thread_time() + BUSY_S
    while time.thread_time() < end:
        sum(range(1000))


def test_time_is_that_of_the_innermost_stage_but_checks_keep_all_they_call() -> None:
    solver = in_file("/x/calibgraph/solver/joint.py", compute)
    check = in_file("/x/calibgraph/trust/checks.py", solver)
    windows = in_file("/x/structure/windows.py", compute)
    score = in_file("/x/structure/shift_scores.py", windows)
    for work, stage in ((solver, "solve"), (check, "checks"), (score, "windows")):
        with StageSampler() as sampler:
            work()
        assert max(STAGES, key=lambda name: sampler.cpu_s[name]) == stage
        assert sampler.cpu_s[stage] > 0.8 * BUSY_S


def test_multiply_adds_are_those_of_the_shifts_inside_the_image() -> None:
    places = np.array([[(0, 0), (2, 1)], [(5, 4), (6, 5)]], np.int32)  # the second leaves earlier
    basis = np.zeros((2, 2, 4), np.float32)
    basis[1, 0, 2] = 1.0
    arguments = {
        "image": np.zeros((7, 9), np.float32), "places": places, "counts": np.array([2, 2]),
        "basis": basis, "origin": np.array([-3, -2]), "grids": np.zeros((1, 5, 7), np.float32),
    }  # fmt: skip
    shifts = [
        sum(
            all(0 <= u + x < 9 and 0 <= v + y < 7 for u, v in window)
            for x in range(-3, 4)
            for y in range(-2, 3)
        )
        for window in places
    ]
    expected = 2 * (4 * shifts[0] + 6 * shifts[1])
    assert gate.Call(arguments).multiply_adds() == expected


@pytest.mark.slow
@pytest.mark.skipif(bool(ceres.why_not()), reason=ceres.why_not() or "there")
def test_ceres_finds_the_same_minimum_in_both_passes(tmp_path: Path) -> None:
    problem = Problem.draw(1, 3)
    ours = solve_ours(problem)
    run = ceres.solve_ceres(ceres.compile_program(tmp_path), problem, ours.first)
    inliers = problem.without_outliers(ours.first)
    assert ours.second is not None and run.passes.second is not None
    costs = inliers.cost(run.passes.second), inliers.cost(ours.second)
    # it stops at relative changes of 1e-8 of the cost
    assert problem.cost(run.passes.first) == pytest.approx(problem.cost(ours.first), rel=1e-7)
    assert costs[0] == pytest.approx(costs[1], rel=1e-7)


def test_the_gate_names_what_became_slower_than_the_release(
    capsys: pytest.CaptureFixture[str],
) -> None:
    former = {"solve / TRF": 0.1, "kernel / sgemm": 1.0, "gone": 1.0}
    found = {"solve / TRF": 0.124, "kernel / sgemm": 1.26, "new": 5.0}
    assert gate.slower(found, former) == ["kernel / sgemm"]
    text = gate.compare(found, former).text()
    assert "1.24" in text and "1.26" in text and "gone" not in text
