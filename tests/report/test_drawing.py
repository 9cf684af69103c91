"""Diagrams that other processes draw."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from calibgraph import Calibration
from calibgraph.errors import CalibrationError
from calibgraph.report import drawing
from calibgraph.report.drawing import DrawingProcess, drawing_processes
from calibgraph.report.html import write_report

_DIES = {"dies": partial(os.kill, 0, signal.SIGKILL)}  # 0: the group of the process that draws
_HOLDER = """
import os, sys, time
from calibgraph.report import drawing
drawing.count_cores = lambda: 2
with drawing.drawing_processes() as draw:
    print(draw({"pid": __import__("functools").partial(os.getpid)})()["pid"], flush=True)
    time.sleep(60)
"""


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "count_cores", lambda: 2)


@pytest.mark.usefixtures("two_cores")
def test_pages_drawn_by_another_process_are_equal(solved_pair: Calibration, tmp_path: Path) -> None:
    with drawing_processes() as draw:
        there = write_report(solved_pair, tmp_path / "there.html", draw=draw)
        pid = draw({"pid": partial(os.getpid)})()["pid"]
    assert pid != os.getpid()
    here = write_report(solved_pair, tmp_path / "here.html")
    assert there.read_bytes() == here.read_bytes()
    assert there.read_text("utf-8").count("data:image/png") == 12  # six of each camera
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid), 0)


@pytest.mark.usefixtures("two_cores")
def test_the_death_of_the_process_is_one_error() -> None:
    with (
        drawing_processes() as draw,
        pytest.raises(CalibrationError, match=r"diagrams of the report .* SIGKILL"),
    ):
        draw(_DIES)()


@pytest.mark.usefixtures("two_cores")
def test_an_error_of_a_diagram_is_raised_here() -> None:
    with drawing_processes() as draw, pytest.raises(ValueError, match="literal for int"):
        draw({"wrong": partial(int, "wrong")})()


@pytest.mark.usefixtures("two_cores")
def test_diagrams_are_drawn_here_where_no_process_can_be_started(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sys, "executable", "/nonexistent/python")
    with drawing_processes() as draw:
        assert draw({"pid": partial(os.getpid)})() == {"pid": os.getpid()}
    assert "drawn in this process: no process can be started" in caplog.text


def test_a_process_that_still_loads_is_ended() -> None:
    start = time.monotonic()
    process = DrawingProcess()
    process.close()
    assert process._child._process is None
    assert time.monotonic() - start < 30


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_the_process_ends_with_its_parent(how: signal.Signals) -> None:
    parent = subprocess.Popen([sys.executable, "-c", _HOLDER], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    with parent.stdout:
        pid = int(parent.stdout.readline())
    os.kill(pid, 0)
    parent.send_signal(how)
    parent.wait()
    end = time.monotonic() + 30
    while Path(f"/proc/{pid}").exists() and not _is_zombie(pid):
        assert time.monotonic() < end
        time.sleep(0.02)


def _is_zombie(pid: int) -> bool:
    """Whether it has ended, and nobody has asked how."""
    try:
        return ") Z " in Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return True
