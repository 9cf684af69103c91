"""The command `track` under `kill -9`."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from calibgraph import concatenate, perturb
from calibgraph.cli import app
from calibgraph.tracking import durable
from tests.tracking.drives import drive, frames_in, pair_of

MOST_TOGETHER = 50  # frames of one write: all its lines come again

pytestmark = pytest.mark.usefixtures("not_warmed_up")


def _command(arguments: list[str], lines: Path, state_every: int) -> None:
    """In a process of its own: ``track`` with standard output appended to a file."""
    for descriptor, path in ((1, lines), (2, lines.with_suffix(".err"))):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        os.dup2(file, descriptor)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    durable._STATE_EVERY = state_every
    sys.argv = ["calibgraph", "track", *arguments]
    app.main()


@dataclass
class Killed:
    """A command that is killed and started again, and the lines that it printed in between."""

    arguments: list[str]
    path: Path
    state_every: int = 7

    def run(self, when: Callable[[], bool] | None) -> bool:
        """Start it, and kill it when that is so; whether it ended by itself, and well."""
        self._cut_half_a_line()
        before = self.lines
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(
            ["tests.tracking.test_command_kills", "pyarrow.parquet", "calibgraph.report.tables"]
        )
        process = context.Process(
            target=_command, args=(self.arguments, self.path, self.state_every)
        )
        process.start()
        while process.is_alive() and not (when is not None and when()):
            process.join(0.002)
        process.kill()
        process.join()
        if before and (after := self.lines[len(before) :]):
            last, first = frames_in(before[-1])[0], frames_in(after[0])[0]
            assert first > last - MOST_TOGETHER, "an update that was acknowledged is lost"
        assert process.exitcode in (0, -signal.SIGKILL), self.path.with_suffix(".err").read_text()
        return process.exitcode == 0

    @property
    def lines(self) -> list[str]:
        """The complete ones."""
        text = self.path.read_text() if self.path.exists() else ""
        return text[: text.rfind("\n") + 1].splitlines()

    def after(self, delay_s: float, printed: int) -> Callable[[], bool]:
        """Whether a time has passed since so many lines were there."""
        begun: list[float] = []

        def passed() -> bool:
            if not begun and (not printed or len(self.lines) >= printed):
                begun.append(time.monotonic())
            return bool(begun) and time.monotonic() - begun[0] >= delay_s

        return passed

    def acknowledged(self) -> list[str]:
        """The lines, those of a write that came again once: the same to the last digit."""
        by_frame: dict[int, str] = {}
        for line in self.lines:
            assert by_frame.setdefault(frames_in(line)[0], line) == line
        return [*by_frame.values()]

    def _cut_half_a_line(self) -> None:
        if self.path.exists():
            text = self.path.read_text()
            self.path.write_text(text[: text.rfind("\n") + 1])


def kill_often(folder: Path, kills: int, longest_s: float, seed: int) -> int:
    """Kill at random moments, from the start to well into the drive; how many drives that took.

    The drive has failed matches, a move, and epochs that close.
    """
    truth = pair_of()
    guess = perturb(truth, rotation_deg=1, translation_m=0.1, seed=1)
    tables = drive(truth, 60, moves_at=33, failed_share=0.1)
    guess.save(folder / "rig.yaml")
    concatenate(tables).save(folder / "matches.parquet")
    arguments = [str(folder / "rig.yaml"), str(folder / "matches.parquet"), "--out"]
    whole = Killed([*arguments, str(folder / "whole")], folder / "whole.jsonl")
    assert whole.run(None)
    assert len(whole.lines) == len(tables)
    rng, done, drives = np.random.default_rng(seed), 0, 0
    while done < kills:
        killed = Killed([*arguments, str(folder / str(drives))], folder / f"{drives}.jsonl")
        ended = False
        while not ended and done < kills:
            printed = len(killed.lines) + rng.integers(1, 12) if rng.random() < 0.5 else 0
            delay_s = rng.uniform(0, 0.01 if printed else longest_s)
            ended = killed.run(killed.after(delay_s, printed))
            done += not ended
        assert ended or killed.run(None)
        assert killed.acknowledged() == whole.lines
        drives += 1
    return drives


@pytest.mark.ci
@pytest.mark.slow
def test_random_kills_lose_nothing_and_change_nothing(tmp_path: Path) -> None:
    kills = int(os.environ.get("CALIBGRAPH_TEST_KILLS", "5"))
    assert kill_often(tmp_path, kills, longest_s=0.6, seed=int.from_bytes(os.urandom(4))) >= 1
