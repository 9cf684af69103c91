"""Damaged clouds, tables and bags are read or refused in one line: no signal, and no memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "count", "most_mb"),
    [
        ("cloud_fuzz", 300, 300),  # that numpy takes for a moment; a header may claim exabytes
        pytest.param("cloud_fuzz", 10_000, 300, marks=slow),
        pytest.param("table_fuzz", 300, 200, marks=slow),
        ("bags.fuzz", 60, 200),
        pytest.param("bags.fuzz", 2000, 200, marks=slow),
    ],
)
def test_damaged_files_are_read_or_refused(
    kind: str, count: int, most_mb: int, tmp_path: Path
) -> None:
    if kind == "bags.fuzz":
        pytest.importorskip("mcap")
    command = [sys.executable, "-m", f"tests.io.{kind}", "1", str(count), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    last = tmp_path / "last"
    told = last.read_text() if last.exists() else ""
    assert done.returncode == 0, f"{told}: {done.returncode} {done.stderr[-1000:]}"
    read, refused, grown_mb = map(int, done.stdout.split())
    assert read > (0 if kind == "table_fuzz" else count / 20) and refused > count / 2
    assert grown_mb < most_mb
