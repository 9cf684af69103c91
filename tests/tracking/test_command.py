"""The command track: its output, its sources, signals, and folders that grow."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pyarrow import parquet

from calibgraph import Config, Correspondences, concatenate
from calibgraph.tracking import command
from calibgraph.tracking.command import Tracking, track
from tests.conftest import Call
from tests.tracking.drives import (
    FRAMES,
    World,
    as_lines,
    content_of,
    file_lines,
    frames_in,
)

to_arrow = Correspondences.to_arrow
pytestmark = pytest.mark.usefixtures("no_picture")


def test_every_update_is_a_line_of_json(world: World, call: Call, tmp_path: Path) -> None:
    code, out, err = call("track", world.rig, world.source, "--out", tmp_path / "out")
    assert code == 0
    assert out.splitlines() == world.file_lines
    assert f"{FRAMES} updates, 0 left out" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "state",
        "calibration.yaml",
        "track.png",
    }


@pytest.mark.parametrize("kind", ["lines", "by camera", "csv"])
def test_every_source_gives_the_same_lines(
    kind: str, world: World, call: Call, piped: Call, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    whole = concatenate(world.tables)
    if kind == "lines":
        code, text, _ = piped(world.rig, as_lines(world.tables), *out)
    else:
        source = tmp_path / "given"
        if kind == "csv":
            source = source.with_suffix(".csv")
            whole.save(source)
            config = tmp_path / "config.yaml"  # since a CSV file states nothing
            config.write_text("common_deg: 0\ncommon_cm: 0\n")
            out = (*out, "--config", config)
        else:
            source = source.with_suffix(".parquet")
            rows = np.lexsort((whole.frame, whole.camera_index))
            parquet.write_table(to_arrow(whole.select(rows)), source, row_group_size=100)
        code, text, _ = call("track", world.rig, source, *out)
    assert code == 0
    assert text.splitlines() == (world.lines if kind == "lines" else world.file_lines)


def test_every_nth_frame_is_taken_also_after_a_restart(
    world: World, call: Call, tmp_path: Path
) -> None:
    half = tmp_path / "half.parquet"
    concatenate(world.tables[:8]).save(half)
    every = ("--step", 3, "--out", tmp_path / "out")
    _, first, _ = call("track", world.rig, half, *every)
    _, second, err = call("track", world.rig, world.source, *every)
    assert frames_in(first) == [0, 3, 6] and frames_in(second) == [9, 12]
    assert "going on after frame 6" in err and "3 known from before" in err
    assert (first + second).splitlines() == file_lines(
        world.guess, world.tables[:8:3], world.tables[9::3]
    )


@pytest.mark.parametrize("numbers", [(10**18, 10**8), (-(2**63), 1), (-5, 1), (2**63 - 15, 1)])
def test_frame_numbers_may_be_any_of_64_bits(
    numbers: tuple[int, int], world: World, piped: Call, tmp_path: Path
) -> None:
    first, step = numbers
    contents = [content_of(table) for table in world.tables]
    for place, content in enumerate(contents):
        content["frame"] = first + step * place
        content["stamp_ns"] = 10**18 + place
    given = b"".join(json.dumps(content).encode() + b"\n" for content in contents)
    code, out, _ = piped(world.rig, given, "--out", tmp_path / "out")
    assert code == 0
    assert frames_in(out) == [content["frame"] for content in contents]
    for line, other in zip(out.splitlines(), world.lines, strict=True):
        found, expected = json.loads(line), json.loads(other)
        assert found["cameras"] == expected["cameras"]
    assert json.loads(out.splitlines()[-1])["stamp_ns"] == 10**18 + FRAMES - 1


@pytest.mark.parametrize(
    ("key", "number", "reason"),
    [
        ("frame", 2**63 - 1, f"its number {2**63 - 1} is the largest"),
        ("stamp_ns", 2**63 - 1, f"its stamp_ns {2**63 - 1} is the largest"),
        ("frame", 2**63 - 2, f"{2**63 - 2} is far beyond"),
        ("frame", 10**13, f"{10**13} is far beyond"),
        ("stamp_ns", 2**63 - 2, f"{2**63 - 2} is far beyond"),
    ],
)
def test_a_number_far_beyond_the_last_one_does_not_make_all_others_late(
    key: str, number: int, reason: str, world: World, piped: Call, tmp_path: Path
) -> None:
    contents = [content_of(table) for table in world.tables]
    for place, content in enumerate(contents):
        content["stamp_ns"] = 10**18 + place
    wrong = {**contents[6], key: number}
    given = [json.dumps(c).encode() + b"\n" for c in (*contents[:6], wrong, *contents[6:])]
    code, out, err = piped(world.rig, b"".join(given), "--out", tmp_path / "out")
    assert code == 0
    assert frames_in(out) == [content["frame"] for content in contents]
    assert reason in err


def test_a_reader_that_goes_away_ends_it_with_all_saved(
    world: World, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    arguments = ("track", world.rig, world.source, "--out", tmp_path / "out")
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as gone, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", gone)
        code, _, err = call(*arguments)
    assert code == 1  # one frame gives no estimate: FAIL
    assert "the reader of standard output is gone" in err and "Traceback" not in err
    code, out, _ = call(*arguments)
    assert code == 0 and out.splitlines() == world.file_lines[1:]


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
    kind: int, at: int, expected: int, world: World, piped: Call, tmp_path: Path
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
    world: World, monkeypatch: pytest.MonkeyPatch, piped: Call, tmp_path: Path
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
