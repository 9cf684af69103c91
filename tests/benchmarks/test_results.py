"""The benchmarks can be called, and benchmarks/notes/results.md is what they recorded."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "benchmarks").glob("*/*.py")
    if path.stem != "__init__"
)
COMMANDS = [name for name in MODULES if '__name__ == "__main__"' in
            (ROOT / (name.replace(".", "/") + ".py")).read_text()]  # fmt: skip


def python(*arguments: object) -> str:
    """Standard output of Python, run in the checkout."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_benchmark_can_be_imported() -> None:
    python("-c", "\n".join(f"import {name}" for name in MODULES))


def test_the_readme_lists_every_benchmark() -> None:
    text = (ROOT / "benchmarks" / "README.md").read_text()
    for name in COMMANDS:
        assert f"| `{name.removeprefix('benchmarks.').removesuffix('.__main__')}` |" in text


def test_tables_are_recorded_with_commit_and_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from benchmarks import tables

    monkeypatch.setattr(tables, "RESULTS", tmp_path)
    monkeypatch.setattr(tables, "commit", lambda: "0123456")
    monkeypatch.setattr(sys, "argv", ["solve.py", "--frames", "10", "--record"])
    table = tables.Table("Times", ("solver", "time [s]"), (("ours", "0.1"), ("theirs", "12.0")))
    tables.publish("speed.solve", [table], record=True)
    assert "theirs      12.0" in capsys.readouterr().out
    (line,) = (tmp_path / "speed.solve.jsonl").read_text().splitlines()
    assert json.loads(line)["command"] == "python -m benchmarks.speed.solve --frames 10"
    assert tables.Entry.from_json(line).tables == (table,)
    assert tables.Entry.from_json(line).commit == "0123456"


def test_the_results_page_is_written_from_the_results_files() -> None:
    from benchmarks import results

    assert results.PAGE.read_text("utf-8") == results.page()
