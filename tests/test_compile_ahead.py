"""The process that compiles the solver's kernels in a machine's first run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from calibgraph import compile_ahead
from calibgraph.child_process import ChildEndedError, ChildProcess
from calibgraph.compile_ahead import ask_to_compile
from calibgraph.simulation.rigs import rig_of
from tests.conftest import SAMPLE

RIG = rig_of("kitti")
IN_AN_EMPTY_CACHE = """
import sys
from pathlib import Path
from calibgraph import simulate_correspondences, solve
from calibgraph.child_process import ChildProcess
from calibgraph.compile_ahead import ask_to_compile
from calibgraph.simulation.rigs import rig_of
from factors.compiled import is_kept

rig, cache = rig_of("kitti"), Path(sys.argv[1])
before = is_kept("factors.kernel")
child = ChildProcess("calibgraph.compile_ahead")
ask_to_compile(child, rig)
child.close()
kept = set(cache.rglob("*.nbc"))
solve(rig, simulate_correspondences(rig, frames=10, matches=600, seed=1))
print(before, is_kept("factors.kernel"), len(kept) > 20)
print(*(path.name for path in set(cache.rglob("*.nbc")) - kept))
"""

TWO_FRAMES = """
import sys
from calibgraph import calibrate, load_dataset
result = calibrate(load_dataset(sys.argv[1]).select("0:2"))
print(*(T.tobytes().hex() for T in result.T_camera_lidar.values()))
"""


@pytest.mark.slow
def test_a_solve_finds_its_kernels_compiled(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", IN_AN_EMPTY_CACHE, str(tmp_path)],
        env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["False", "True", "True"]  # and no other


@pytest.mark.slow
def test_the_first_run_of_a_machine_gives_the_numbers_of_later_ones(tmp_path: Path) -> None:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first, later = (
        subprocess.check_output([sys.executable, "-c", TWO_FRAMES, SAMPLE], env=environment)
        for _ in range(2)
    )
    assert first == later


@pytest.mark.parametrize(("cores", "kept"), [(1, False), (2, True), (2, None)])
def test_no_process_starts_with_one_core_or_nothing_to_keep(
    monkeypatch: pytest.MonkeyPatch, cores: int, kept: bool | None
) -> None:
    monkeypatch.setattr(compile_ahead, "count_cores", lambda: cores)
    monkeypatch.setattr(compile_ahead, "is_kept", lambda _: kept)
    monkeypatch.setattr(compile_ahead, "ChildProcess", pytest.fail)
    with compile_ahead.compile_ahead(RIG):
        pass


def test_the_process_ends_with_the_work_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    children: list[ChildProcess] = []

    def remember(module: str) -> ChildProcess:
        children.append(ChildProcess(module))
        return children[0]

    monkeypatch.setattr(compile_ahead, "count_cores", lambda: 2)
    monkeypatch.setattr(compile_ahead, "is_kept", lambda _: False)
    monkeypatch.setattr(compile_ahead, "ChildProcess", remember)
    with compile_ahead.compile_ahead(RIG):
        pass
    with pytest.raises(ChildEndedError):
        children[0].start()


def test_a_process_that_cannot_start_costs_only_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/nonexistent/python")
    ask_to_compile(ChildProcess(compile_ahead.__name__), RIG)
