"""Progress with and without a terminal."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from calibgraph.cli import terminal
from calibgraph.cli.terminal import LINE_EVERY_S, progress_lines
from tests.conftest import SAMPLE, Call


def test_lines_of_progress_have_time_stage_and_steps_and_are_not_too_many() -> None:
    now, lines = [0.0], []
    progress = progress_lines(lines.append, clock=lambda: now[0])
    for step in range(1000):
        now[0] = step * LINE_EVERY_S / 100
        progress("round 1 of 3: front", step, 1000)
    assert lines[0] == "    5 s  round 1 of 3: front, 100 of 1000"
    assert len(lines) == 9


def test_a_terminal_shows_a_bar_with_the_time_that_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(
        terminal, "terminal", lambda: Console(file=screen, force_terminal=True, width=100)
    )
    with terminal.progress_bar() as progress:
        progress("round 1 of 3: front", 1, 4)
    shown = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", screen.getvalue())
    assert re.search(r"round 1 of 3: front.* 0:00:00 left -:--:--", shown)


def test_short_work_prints_no_progress(call: Call, tmp_path: Path) -> None:
    _, _, err = call("doctor", SAMPLE, "--frames", "0")
    assert " of " not in "".join(line for line in err.splitlines() if " s  " in line)
