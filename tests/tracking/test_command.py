"""The command `track`: its output, its sources, its standard streams."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from calibgraph import (
    Correspondences,
    Rig,
    concatenate,
    perturb,
)
from calibgraph.io.rigs import load_rig
from tests.conftest import Call, make_camera, stereo_relative_pose
from tests.tracking.drives import (
    FRAMES,
    World,
    as_lines,
    content_of,
    drive,
    file_lines,
    frames_in,
    pair_of,
)

to_arrow = Correspondences.to_arrow
pytestmark = pytest.mark.usefixtures("no_picture")


# What it gives


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


@pytest.mark.parametrize("kind", ["lines", "by camera", "csv", "folder"])
def test_every_source_gives_the_same_lines(
    kind: str, world: World, call: Call, piped: Callable[..., Any], tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    whole = concatenate(world.tables)
    if kind == "lines":
        code, text, _ = piped(world.rig, as_lines(world.tables), *out)
    else:
        source = tmp_path / "given"
        if kind == "folder":
            for number in (0, 7):
                whole.select((whole.frame // 7) * 7 == number).save(source / f"{number}.parquet")
        elif kind == "csv":
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
    numbers: tuple[int, int], world: World, piped: Callable[..., Any], tmp_path: Path
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


@pytest.mark.parametrize("key", ["frame", "stamp_ns"])
def test_a_number_that_nothing_can_follow_is_left_out(
    key: str, world: World, piped: Callable[..., Any], tmp_path: Path
) -> None:
    contents = [content_of(table) for table in world.tables]
    for place, content in enumerate(contents):
        content["stamp_ns"] = 10**18 + place
    wrong = {**contents[6], key: 2**63 - 1}
    given = [json.dumps(c).encode() + b"\n" for c in (*contents[:6], wrong, *contents[6:])]
    code, out, err = piped(world.rig, b"".join(given), "--out", tmp_path / "out")
    assert code == 0
    assert frames_in(out) == [content["frame"] for content in contents]
    assert f"its {'number' if key == 'frame' else key} {2**63 - 1} is the largest" in err


@pytest.mark.parametrize(
    ("key", "number"),
    [("frame", 2**63 - 2), ("frame", 2**53), ("frame", 10**13), ("stamp_ns", 2**63 - 2)],
)
def test_a_number_far_beyond_the_last_one_does_not_make_all_others_late(
    key: str, number: int, world: World, piped: Callable[..., Any], tmp_path: Path
) -> None:
    contents = [content_of(table) for table in world.tables]
    for place, content in enumerate(contents):
        content["stamp_ns"] = 10**18 + place
    wrong = {**contents[6], key: number}
    given = [json.dumps(c).encode() + b"\n" for c in (*contents[:6], wrong, *contents[6:])]
    code, out, err = piped(world.rig, b"".join(given), "--out", tmp_path / "out")
    assert code == 0
    assert frames_in(out) == [content["frame"] for content in contents]
    assert f"{number} is far beyond" in err


@pytest.mark.parametrize("kind", ["one", "mixed", "tied"])
def test_any_rig_continues_with_the_same_lines(
    kind: str, mixed_rig: Rig, call: Call, tmp_path: Path
) -> None:
    tied = pair_of()
    truth = {
        "one": Rig(cameras={"only": make_camera()}),
        "mixed": mixed_rig,
        "tied": tied.model_copy(update={"relative_poses": (stereo_relative_pose(tied),)}),
    }[kind]
    guess = perturb(truth, rotation_deg=1, translation_m=0.1, seed=2)
    guess.save(tmp_path / "rig.yaml")
    guess = load_rig(tmp_path / "rig.yaml")
    tables = drive(truth)
    concatenate(tables[:9]).save(tmp_path / "begin.parquet")
    concatenate(tables).save(tmp_path / "whole.parquet")
    arguments = ("--out", tmp_path / "out")
    _, first, _ = call("track", tmp_path / "rig.yaml", tmp_path / "begin.parquet", *arguments)
    code, second, _ = call("track", tmp_path / "rig.yaml", tmp_path / "whole.parquet", *arguments)
    assert code == 0
    assert (first + second).splitlines() == file_lines(guess, tables[:9], tables[9:])


# Sources that hold nothing, and standard streams that are closed


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
