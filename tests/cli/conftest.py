from pathlib import Path
from typing import Any

import pytest

from calibgraph import MatcherErrors, Rig, perturb, simulate_correspondences
from tests.conftest import CommandRun, make_pair, run_command


def save_problem(folder: Path) -> Path:
    """A folder with a rig, its truth, and a table of correspondences."""
    pair = make_pair()
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.15)
    table = simulate_correspondences(pair, frames=8, matches=200, errors=errors)
    table.save(folder / "table.parquet")
    pair.save(folder / "truth.yaml")
    perturb(pair, rotation_deg=2, translation_m=0.2).save(folder / "rig.yaml")
    return folder


def words_to_solve(folder: Path, rig: Rig, **simulated: Any) -> tuple[str | Path, ...]:
    """The words that solve a simulated table of a rig, saved in a folder, into ``out``."""
    rig.save(folder / "rig.yaml")
    simulate_correspondences(rig, **simulated).save(folder / "table.parquet")
    return "solve", folder / "rig.yaml", folder / "table.parquet", "--out", folder / "out"


@pytest.fixture(scope="session")
def solved(tmp_path_factory: pytest.TempPathFactory) -> CommandRun:
    """``solve`` of the problem, with seed 3; its folder is ``out`` in that of the problem."""
    problem = save_problem(tmp_path_factory.mktemp("solved"))
    (problem / "seed.yaml").write_text("seed: 3\n")
    inputs = problem / "rig.yaml", problem / "table.parquet", "--config", problem / "seed.yaml"
    return run_command("solve", *inputs, "--out", problem / "out", folder=problem / "out")


@pytest.fixture
def problem(tmp_path: Path) -> Path:
    """See :func:`save_problem`."""
    return save_problem(tmp_path)


def error_line(code: int, out: str, err: str) -> str:
    """The message of bad input: exit code 2, nothing on stdout, one line on stderr."""
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1, err
    assert err.startswith("calibgraph: ")
    assert "internal error" not in err
    return err
