"""Damaged headers and bodies of clouds give points or one line: no signal, and no memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

MOST_MB = 300  # that numpy takes for a moment; a header may claim exabytes


@pytest.mark.parametrize("count", [300, pytest.param(10_000, marks=pytest.mark.slow)])
def test_damaged_clouds_are_read_or_refused(count: int, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.io.cloud_fuzz", "1", str(count), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    last = (tmp_path / "last").read_text()
    assert done.returncode == 0, f"{last}: {done.returncode} {done.stderr[-1000:]}"
    read, refused, grown_mb = map(int, done.stdout.split())
    assert read > count / 20 and refused > count / 2
    assert grown_mb < MOST_MB
