"""The command `track`: signals, and folders that grow."""

from __future__ import annotations

import io
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from calibgraph import (
    Config,
    concatenate,
)
from calibgraph.tracking import command
from calibgraph.tracking.command import Tracking, track
from tests.conftest import Call
from tests.tracking.drives import (
    FRAMES,
    World,
    as_lines,
)

pytestmark = pytest.mark.usefixtures("no_picture")


# Stops


class Feed:
    """Lines, one a read; before the one of a given number something is done."""

    def __init__(self, lines: Sequence[bytes], number: int, act: Callable[[], None]) -> None:
        self._lines = iter(lines)
        self._left = number
        self._act = act

    def read1(self, _: int) -> bytes:
        if self._left == 0:
            self._act()
        self._left -= 1
        return next(self._lines, b"")

    read = read1

    def fileno(self) -> int:
        raise OSError("not a file")


@pytest.mark.parametrize("kind", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize(("at", "expected"), [(10, 0), (3, 1)])
def test_a_signal_ends_it_with_the_code_of_the_verdict(
    kind: int, at: int, expected: int, world: World, piped: Callable[..., Any], tmp_path: Path
) -> None:
    lines = as_lines(world.tables).splitlines(keepends=True)
    before = signal.getsignal(kind)
    feed = Feed(lines, at, lambda: signal.raise_signal(kind))
    code, first, err = piped(world.rig, feed, "--out", tmp_path / "out")
    assert code == expected
    assert "Traceback" not in err and (tmp_path / "out" / "calibration.yaml").is_file()
    assert signal.getsignal(kind) is before
    assert len(first.splitlines()) in (at, at + 1)
    _, second, _ = piped(world.rig, as_lines(world.tables), "--out", tmp_path / "out")
    assert (first + second).splitlines() == world.lines


def test_a_second_signal_ends_it_at_once_and_loses_nothing(
    world: World, monkeypatch: pytest.MonkeyPatch, piped: Callable[..., Any], tmp_path: Path
) -> None:
    given: list[str] = []

    def write(line: str) -> None:
        given.append(line)
        if len(given) == 4:  # as if this line were never taken
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    lines = io.BytesIO(as_lines(world.tables))
    wanted = Tracking(rig=world.guess, config=Config(), out=tmp_path)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may ignore it
    try:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(command, "print_line", write)
            patch.setattr(sys, "stdin", SimpleNamespace(buffer=lines))
            track(wanted, [Path("-")], notify=print)
    finally:
        signal.signal(signal.SIGINT, before)
    _, out, _ = piped(world.rig, as_lines(world.tables), "--out", tmp_path)
    assert given[:3] + out.splitlines() == world.lines


def test_a_growing_folder_is_followed_until_a_signal(
    world: World, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    given: list[str] = []

    def write(line: str) -> None:
        """After each file is done, the next one comes."""
        given.append(line)
        if len(given) == FRAMES:
            signal.raise_signal(signal.SIGTERM)
        elif len(given) % 7 == 0:
            concatenate(world.tables[7:]).save(folder / "2.parquet")

    monkeypatch.setattr(command, "print_line", write)
    concatenate(world.tables[:7]).save(folder / "1.parquet")
    code, _, _ = call("track", world.rig, folder, "--follow", "--out", tmp_path / "out")
    assert code == 0 and given == world.lines
