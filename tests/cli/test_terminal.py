"""Progress with and without a terminal."""

from __future__ import annotations

import io
import logging

import pytest
from rich.table import Table

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


def test_names_of_others_do_nothing_to_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, name = io.StringIO(), "a\x1b[2Jb\x7fc\x9b2Jd\u202ee"
    monkeypatch.setattr("sys.stderr", screen)
    console = terminal.terminal()
    terminal.print_line(name)
    table = Table(name)
    table.add_row(name)
    console.print(table)
    with terminal.progress_bar(name):
        logging.getLogger("calibgraph").warning(name)
    shown = screen.getvalue()
    assert shown.count("a\\x1b[2Jb") == 4
    assert all(line.isprintable() for line in shown.splitlines())


def test_a_file_name_in_an_error_does_nothing_to_a_terminal(call: Call) -> None:
    code, _, err = call("evaluate", "no\x1b[2J\u202esuch", SAMPLE)
    assert code == 2 and err.strip().isprintable() and "no\\x1b[2J\\u202esuch" in err
