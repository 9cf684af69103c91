"""Damaged tables are read or refused in one line, each in a child: no signal, and no memory."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

MOST_MB = 200


@pytest.mark.slow
def test_damaged_tables_are_read_or_refused(tmp_path: Path) -> None:
    count = 300
    command = [sys.executable, "-m", "tests.io.table_fuzz", "1", str(count), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-1000:]
    read, refused, grown_mb = map(int, done.stdout.split())
    assert read and refused > count / 2
    assert grown_mb < MOST_MB
