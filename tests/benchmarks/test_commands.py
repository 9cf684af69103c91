"""The benchmarks can be called and are listed, and those of speed measure what they state."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import tables
from benchmarks.speed import gate
from calibgraph.matching.structure.score_kernel import pad
from tests.conftest import ROOT

MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for folder in ("benchmarks", "tools")
    for path in (ROOT / folder).rglob("*.py")
    if path.stem != "__init__"
)
COMMANDS = [name for name in MODULES if '__name__ == "__main__"' in
            (ROOT / (name.replace(".", "/") + ".py")).read_text()]  # fmt: skip


def test_every_benchmark_and_tool_can_be_imported() -> None:
    command = [sys.executable, "-c", "\n".join(f"import {name}" for name in MODULES)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_readme_lists_every_benchmark_and_tool() -> None:
    text = (ROOT / "benchmarks" / "README.md").read_text()
    for name in COMMANDS:
        assert f"| `{name.removeprefix('benchmarks.').removesuffix('.__main__')}` |" in text


def test_tables_are_markdown_below_the_command_that_made_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["solve.py", "--frames", "10"])
    rows = (("ours", "0.1"), ("theirs", "12.0"))
    tables.publish([tables.Table("Times", ("solver", "time [s]"), rows)])
    text = capsys.readouterr().out
    assert "--frames 10`, " in text and tables.commit() in text
    assert text.endswith(
        "Times:\n\n| solver | time [s] |\n| ---    |      --- |\n"
        "| ours   |      0.1 |\n| theirs |     12.0 |\n"
    )


def test_multiply_adds_are_those_of_the_shifts_inside_the_image() -> None:
    places = np.array([[(0, 0), (2, 1)], [(5, 4), (6, 5)]], np.int32)  # the second leaves earlier
    basis = np.zeros((2, 2, 4), np.float32)
    basis[1, 0, 2] = 1.0
    call = {
        "padded": pad(np.zeros((7, 9), np.float32)), "places": places, "counts": np.array([2, 2]),
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
    assert gate.multiply_adds(call) == 2 * (4 * shifts[0] + 6 * shifts[1])


def test_the_gate_names_what_became_slower_than_the_release() -> None:
    former = {"solve / TRF": 0.1, "kernel / sgemm": 1.0, "gone": 1.0}
    found = {"solve / TRF": 0.124, "kernel / sgemm": 1.26, "new": 5.0}
    assert gate.slower(found, former) == ["kernel / sgemm"]
    text = gate.compare(found, former).text()
    assert "1.24" in text and "1.26" in text and "gone" not in text
