"""The command track: its output, its sources, signals, and wrong input."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from calibgraph import Config, Correspondences, concatenate
from calibgraph.tracking import command
from calibgraph.tracking.command import track
from tests.conftest import Call
from tests.tracking.drives import (
    FRAMES,
    World,
    as_lines,
    content_of,
    expected_lines,
    file_lines,
    frames_in,
)

to_arrow = Correspondences.to_arrow
pytestmark = pytest.mark.usefixtures("not_warmed_up")


def test_every_update_is_a_line_of_json(world: World, call: Call, tmp_path: Path) -> None:
    code, out, err = call("track", world.rig, world.source, "--out", tmp_path / "out")
    assert code == 0
    assert out.splitlines() == world.file_lines
    assert f"{FRAMES} updates, 0 left out" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "state",
        "calibration.yaml",
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


def test_a_restart_goes_on_after_the_last_frame(world: World, call: Call, tmp_path: Path) -> None:
    half, out = tmp_path / "half.parquet", ("--out", tmp_path / "out")
    concatenate(world.tables[:8]).save(half)
    _, first, _ = call("track", world.rig, half, *out)
    _, second, err = call("track", world.rig, world.source, *out)
    assert "going on after frame 7" in err and "8 known from before" in err
    assert (first + second).splitlines() == file_lines(
        world.guess, world.tables[:8], world.tables[8:]
    )


@pytest.mark.parametrize("numbers", [(10**18, 10**8), (-(2**63), 1), (2**63 - 14, 1)])
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


def test_a_reader_that_goes_away_ends_it_with_all_saved(
    world: World, piped: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given = world.rig, as_lines(world.tables), "--out", tmp_path / "out"
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as gone, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", gone)
        code, _, err = piped(*given)
    assert code == 1  # one frame gives no estimate: FAIL
    assert "the reader of standard output is gone" in err and "Traceback" not in err
    code, out, _ = piped(*given)
    assert code == 0 and out.splitlines() == world.lines[1:]


class Feed:
    """Lines; before the one of a given number something is done."""

    def __init__(self, lines: Sequence[bytes], number: int, act: Callable[[], None]) -> None:
        self._lines = iter(lines)
        self._left = number
        self._act = act

    def readline(self, _: int) -> bytes:
        if self._left == 0:
            self._act()
        self._left -= 1
        return next(self._lines, b"")


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
    assert len(first.splitlines()) == at
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
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may ignore it
    try:
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(command, "print_line", write)
            patch.setattr(sys, "stdin", SimpleNamespace(buffer=lines))
            track(world.guess, "-", config=Config(), out=tmp_path, notify=print)
    finally:
        signal.signal(signal.SIGINT, before)
    _, out, _ = piped(world.rig, as_lines(world.tables), "--out", tmp_path)
    assert given[:3] + out.splitlines() == world.lines


def wrong_lines(good: Correspondences) -> dict[str, bytes]:
    """What is no frame, or a frame that cannot be taken, each with its number before the good."""

    def line(**changes: Any) -> bytes:
        content = content_of(good)
        content["frame"] += 1
        camera = content["cameras"]["left"]
        for key, value in changes.items():
            if key in camera:
                camera[key][3] = value
            else:
                content[key] = value
        return json.dumps(content).encode()

    content = content_of(good)
    return {
        "is not JSON (EOF": line()[:200],
        "not in the rig": line(cameras={"stranger": content["cameras"]["left"]}),
        "comes again": line(frame=content["frame"]),
        "comes after": line(frame=-1),
        "below 1e+06, found [1000000.0": line(u_px=1e6),
        "metadata systematic_rotation_rad": line(metadata={"systematic_rotation_rad": "much"}),
    }


def test_wrong_input_is_left_out_with_a_line_each_and_leaves_no_trace(
    world: World, piped: Callable[..., Any], tmp_path: Path
) -> None:
    """Frames 0, 10, 20, ...; after the seventh everything that can be wrong."""
    tables = [replace(table, frame=10 * table.frame) for table in world.tables]
    wrong = wrong_lines(tables[6])
    given = as_lines(tables[:7]) + b"\n".join(wrong.values()) + b"\n" + as_lines(tables[7:])
    half_a_line = as_lines(tables[:1])[:500]
    code, out, err = piped(world.rig, given + half_a_line, "--out", tmp_path / "out")
    assert code == 0
    assert out.splitlines() == expected_lines(world.guess, tables)
    messages = [line for line in err.splitlines() if line.startswith("left out: ")]
    for line, what in zip(messages, (*wrong, "is not JSON"), strict=True):
        assert what in line
    assert "Traceback" not in err


RULE = "twist must be under 6 rad/s, then under 100 m/s (rotation first, in radians), found ["


@pytest.mark.parametrize("kind", ["matches.parquet", "matches.csv", "-"])
def test_a_motion_of_no_vehicle_ends_it_in_one_line(
    kind: str, world: World, call: Call, piped: Call, tmp_path: Path
) -> None:
    """Translation first: while the vehicle is slow it looks right. A table is read before."""
    out = ("--out", tmp_path / "out")
    twists = np.array([[0, 0, 0, 2.0, 0, 0], [0, 0, 0, 20.0, 0, 0]])[:, [3, 4, 5, 0, 1, 2]]
    if kind == "-":
        contents = [content_of(table) for table in world.tables[:2]]
        lines = [
            json.dumps({**c, "twist_per_s": [*t]}) for c, t in zip(contents, twists, strict=True)
        ]
        code, text, err = piped(world.rig, "\n".join(lines).encode(), *out)
        assert len(text.splitlines()) == 1 and "standard input, line 2: camera 'left': " in err
    else:
        table, path = concatenate(world.tables[:2]), tmp_path / kind
        object.__setattr__(table, "twist_per_s", twists[table.frame])  # a table refuses them
        table.save(path)
        code, text, err = call("track", world.rig, path, *out)
        row = int(np.flatnonzero(table.frame == 1)[0])
        assert not text and not out[1].exists() and err.count("\n") == 1
        assert f"{path}: row {row} (camera 'left', frame 1): " in err
    assert code == 2 and RULE in err


def test_a_lens_or_clock_is_refused_while_driving(world: World, call: Call, tmp_path: Path) -> None:
    settings, out = tmp_path / "config.yaml", tmp_path / "out"
    settings.write_text("estimate: [offset]\n")
    code, text, err = call("track", world.rig, world.source, "--out", out, "--config", settings)
    assert (code, text) == (2, "") and err.count("\n") == 1
    assert "found offset: estimate them with `calibgraph solve`" in err
    assert not out.exists()
