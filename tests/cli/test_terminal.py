"""Progress without a terminal, and former spellings of options."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from rich.console import Console
from typer.main import get_command

from calibgraph.cli import terminal
from calibgraph.cli.app import app
from calibgraph.cli.former_options import FORMER, with_present_options
from calibgraph.cli.terminal import LINE_EVERY_S, progress_lines
from tests.cli.conftest import error_line
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


def test_former_options_become_present_ones() -> None:
    given = ["import", "a.yaml", "--relative-sigma-cm", "0.5", "--relative-sigma-deg=0.2"]
    assert list(with_present_options(given)) == [
        "import", "a.yaml", "--tie-m", "0.005", "--tie-deg=0.2"
    ]  # fmt: skip
    others = ["calibrate", "--data", "x"]
    assert list(with_present_options(others)) == others


@pytest.mark.parametrize("command", FORMER)
def test_present_options_exist_and_former_ones_are_hidden(command: str) -> None:
    commands = get_command(app).commands  # type: ignore[attr-defined]
    known = {name for option in commands[command].params for name in option.opts}
    for former, (present, _) in FORMER[command].items():
        assert present in known and former not in known


def test_a_former_option_does_what_it_did(call: Call, tmp_path: Path) -> None:
    given = ("guess", SAMPLE / "rig.yaml", "--out", tmp_path / "g.yaml", "--search", "left")
    assert "none: no such" in error_line(*call(*given, "--data", tmp_path / "none"))
