"""Progress and names on a terminal; a reader that has gone, a full disk, words that are no text."""

import io
import logging
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
from rich.table import Table

from calibgraph.cli import terminal
from calibgraph.cli.terminal import LINE_EVERY_S, progress_lines
from calibgraph.report.tables import make_table
from tests.conftest import SAMPLE, Call

EVALUATE = f"evaluate {SAMPLE} {SAMPLE}/reference.yaml"


def run_in_shell(line: str) -> tuple[int, str]:
    """Exit code of the command line (not of what reads it), and what is on stderr."""
    command = f"set -o pipefail; {sys.executable} -m calibgraph {line}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    "line",
    [
        f"{EVALUATE} --json | true",
        pytest.param(f"rig {SAMPLE} --out rig.yaml 2>&1 | true", marks=pytest.mark.slow),
        "calibrate --help | true",
        "--version | true",
    ],
)
def test_a_reader_that_has_gone_is_no_error(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_in_shell(line) == (0, "")


@pytest.mark.parametrize(
    ("to", "message"), [(None, "is closed"), ("/dev/full", "cannot be written to")]
)
def test_json_that_cannot_be_printed_is_one_line(
    to: str | None, message: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open(to, "w") if to else nullcontext() as stdout, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stdout)
        code, _, stderr = call(*EVALUATE.split(), "--json")
    assert code == 2
    assert stderr.startswith("calibgraph: standard output") and message in stderr
    assert stderr.count("\n") == 1


def test_an_argument_that_is_not_utf8_is_one_line() -> None:
    code, stderr = run_in_shell("evaluate $'\\xff.yaml' rig.yaml")
    assert code == 2
    assert "not UTF-8; rename" in stderr and stderr.count("\n") == 1


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


def test_tables_are_whole_on_a_narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, row = io.StringIO(), ["front_left", *["-179.999"] * 6]
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("COLUMNS", "40")
    terminal.terminal().print(make_table("Error bar", [row]))
    assert row in [line.split() for line in screen.getvalue().splitlines()]


def test_a_file_name_in_an_error_does_nothing_to_a_terminal(call: Call) -> None:
    code, _, err = call("evaluate", "no\x1b[2J\u202esuch", SAMPLE)
    assert code == 2 and err.strip().isprintable() and "no\\x1b[2J\\u202esuch" in err
