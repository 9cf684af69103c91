"""The command `track` against hostile input, crashes, signals and readers that go away."""

from __future__ import annotations

import errno
import io
import json
import multiprocessing
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import ipc, parquet

from calibgraph import (
    Config,
    CorrespondenceError,
    Correspondences,
    DatasetError,
    DurableCalibrator,
    IncrementalCalibrator,
    MatcherErrors,
    Rig,
    concatenate,
    perturb,
)
from calibgraph.cli import app
from calibgraph.io.dataset import Dataset, load_dataset
from calibgraph.io.rigs import load_rig
from calibgraph.simulation.correspondences import simulate_drive
from calibgraph.tracking import command, durable
from calibgraph.tracking.command import Tracking, track
from calibgraph.tracking.history import History
from calibgraph.tracking.report import json_line
from calibgraph.tracking.run import follow
from calibgraph.tracking.state_database import DATABASE, StateDatabase
from calibgraph.tracking.streams import StreamFrame
from tests.conftest import KANNALA, SAMPLE, Call, make_camera, stereo_relative_pose

to_arrow = Correspondences.to_arrow

FRAMES = 14
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def pair_of(**options: Any) -> Rig:
    return Rig(
        cameras={
            "left": make_camera((0.3, 0.1, -0.1), **options),
            "right": make_camera((0.3, -0.4, -0.1), **options),
        }
    )


def moved_later(rig: Rig, at: int) -> Callable[[int], Rig]:
    """The first camera moves by 3 cm and 0.6 deg."""
    name, T = next(iter(rig.T_camera_lidar.items()))
    step = np.eye(4)
    step[:2, :2] = [[np.cos(0.01), -np.sin(0.01)], [np.sin(0.01), np.cos(0.01)]]
    step[0, 3] = 0.03
    after = rig.moved_to({name: step @ T})
    return lambda frame: after if frame >= at else rig


def drive(
    rig: Rig, frames: int = FRAMES, *, moves_at: int | None = None, **options: Any
) -> list[Correspondences]:
    rig_at = moved_later(rig, frames if moves_at is None else moves_at)
    settings: dict[str, Any] = {"matches": 60, "errors": ERRORS, "seed": 1, **options}
    return list(simulate_drive(rig_at, frames=frames, **settings))


def content_of(table: Correspondences) -> dict[str, Any]:
    """A frame as its line of JSON has it."""
    cameras = {}
    for name in table.cameras:
        own = table.of_camera(name)
        columns = (*own.pixels_px.T, *own.points_lidar_m.T, own.confidence.astype(float))
        keys = ("u_px", "v_px", "x_m", "y_m", "z_m", "confidence")
        cameras[name] = {k: c.tolist() for k, c in zip(keys, columns, strict=True)}
    return {"frame": int(table.frame[0]), "cameras": cameras}


def as_lines(tables: Sequence[Correspondences]) -> bytes:
    return b"".join(json.dumps(content_of(table)).encode() + b"\n" for table in tables)


def expected_lines(rig: Rig, tables: Sequence[Correspondences]) -> list[str]:
    tracker = IncrementalCalibrator(rig)
    return [json_line(tracker.update(table)) for table in tables]


def frames_in(out: str) -> list[int]:
    return [json.loads(line)["frame"] for line in out.splitlines()]


def left_out(err: str) -> list[str]:
    return [line for line in err.splitlines() if line.startswith("left out: ")]


@dataclass
class World:
    """A rig's guess and a drive, as files and in memory."""

    guess: Rig
    rig: Path
    source: Path
    tables: list[Correspondences]
    lines: list[str]


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    folder = tmp_path_factory.mktemp("world")
    guess = perturb(pair_of(), rotation_deg=1, translation_m=0.1, seed=1)
    tables = drive(pair_of())
    guess.save(folder / "rig.yaml")
    guess = load_rig(folder / "rig.yaml")
    concatenate(tables).save(folder / "matches.parquet")
    lines = expected_lines(guess, tables)
    return World(guess, folder / "rig.yaml", folder / "matches.parquet", tables, lines)


@pytest.fixture(autouse=True)
def _no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes a second to draw, and has tests of its own."""
    monkeypatch.setattr(History, "draw", lambda self, path: path.write_bytes(b""))


@pytest.fixture
def piped(monkeypatch: pytest.MonkeyPatch, call: Call) -> Callable[..., tuple[int, str, str]]:
    """Run ``track RIG -`` with bytes, or a file, on standard input."""

    def run(rig: Path, given: Any, *options: object) -> tuple[int, str, str]:
        buffer = io.BytesIO(given) if isinstance(given, bytes) else given
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=buffer))
        return call("track", rig, "-", *options)

    return run


# What it gives


def test_every_update_is_a_line_of_json(world: World, call: Call, tmp_path: Path) -> None:
    code, out, err = call("track", world.rig, world.source, "--out", tmp_path / "out")
    assert code == 0
    assert out.splitlines() == world.lines
    assert f"{FRAMES} updates, 0 left out" in err
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "state",
        "calibration.yaml",
        "track.png",
    }


@pytest.mark.parametrize("kind", ["lines", "arrow", "by camera", "csv", "folder"])
def test_every_source_gives_the_same_lines(
    kind: str, world: World, call: Call, piped: Callable[..., Any], tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    whole = concatenate(world.tables)
    if kind == "lines":
        code, text, _ = piped(world.rig, as_lines(world.tables), *out)
    elif kind == "arrow":
        stream = io.BytesIO()
        arrow = [to_arrow(table) for table in world.tables]
        with ipc.new_stream(stream, arrow[0].schema) as writer:
            for batch in (*arrow[:3], pa.concat_tables(arrow[3:])):
                writer.write_table(batch.combine_chunks())
        code, text, _ = piped(world.rig, stream.getvalue(), *out)
    else:
        source = tmp_path / "given"
        if kind == "folder":
            for number in (0, 7):
                whole.select((whole.frame // 7) * 7 == number).save(source / f"{number}.parquet")
        elif kind == "csv":
            source = source.with_suffix(".csv")
            whole.save(source)
        else:
            source = source.with_suffix(".parquet")
            rows = np.lexsort((whole.frame, whole.camera_index))
            parquet.write_table(to_arrow(whole.select(rows)), source, row_group_size=100)
        code, text, _ = call("track", world.rig, source, *out)
    assert code == 0
    assert text.splitlines() == world.lines


def test_a_line_is_given_once_its_update_is_on_disk(world: World, tmp_path: Path) -> None:
    rig = world.guess

    def write(line: str) -> None:
        shutil.copytree(tmp_path / "state", tmp_path / "copy", dirs_exist_ok=False)
        with DurableCalibrator(tmp_path / "copy", rig) as found:
            assert found.tracker.frame == json.loads(line)["frame"]
        shutil.rmtree(tmp_path / "copy")
        written.append(line)

    written: list[str] = []
    frames = [StreamFrame(int(table.frame[0]), None, table) for table in world.tables[:7]]
    with DurableCalibrator(tmp_path / "state", rig) as calibrator:
        counts = follow(
            frames, calibrator, History(), every=1, stop=lambda: False, write=write, notify=print
        )
    assert counts.updates == 7 and written == world.lines[:7]


def test_every_nth_frame_is_taken_also_after_a_restart(
    world: World, call: Call, tmp_path: Path
) -> None:
    half = tmp_path / "half.parquet"
    concatenate(world.tables[:8]).save(half)
    every = ("--every", 3, "--out", tmp_path / "out")
    _, first, _ = call("track", world.rig, half, *every)
    _, second, err = call("track", world.rig, world.source, *every)
    assert frames_in(first) == [0, 3, 6] and frames_in(second) == [9, 12]
    assert "going on after frame 6" in err and "3 known from before" in err
    assert (first + second).splitlines() == expected_lines(world.guess, world.tables[::3])


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


@pytest.mark.parametrize("kind", ["one", "fisheye", "mixed", "tied"])
def test_any_rig_goes_on_with_the_same_lines(
    kind: str, mixed_rig: Rig, call: Call, tmp_path: Path
) -> None:
    tied = pair_of()
    truth = {
        "one": Rig(cameras={"only": make_camera()}),
        "fisheye": pair_of(model="fisheye", distortion=KANNALA),
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
    assert (first + second).splitlines() == expected_lines(guess, tables)


def test_a_camera_may_come_later_or_never(call: Call, tmp_path: Path) -> None:
    truth = pair_of()
    truth.save(tmp_path / "rig.yaml")
    for right_from, code in ((6, 0), (FRAMES, 1)):
        tables = drive(truth, blind={"right": range(right_from)})
        source, out = tmp_path / f"{right_from}.parquet", tmp_path / str(right_from)
        concatenate(tables).save(source)
        found, text, _ = call("track", tmp_path / "rig.yaml", source, "--out", out)
        assert found == code
        last = json.loads(text.splitlines()[-1])["cameras"]
        assert last["left"]["verdict"] != "FAIL"
        assert (last["right"]["verdict"] == "FAIL") == (code == 1)


# Wrong input


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
        "is not JSON": line()[:200],
        "not in the rig": line(cameras={"stranger": content["cameras"]["left"]}),
        "comes again": line(frame=content["frame"]),
        "comes after": line(frame=-1),
        "NaN is no number": line(u_px=float("nan")),
        "Infinity is no number": line(z_m=float("inf")),
        "below 1e+06, found [1000000.0": line(u_px=1e6),
        "point must be finite": line(x_m=1e6),
        "u_px.3: Input should be a valid number, found '1.5'": line(u_px="1.5"),
        "v_px.3: Input should be a valid number, found True": line(v_px=True),
        "confidence must lie in (0, 1]": line(confidence=1e30),
        "confidence must lie": line(confidence=0),
        "frame: Input should be a valid integer": line(frame=1.5),
        "is missing": b'{"frame": 7}',
        "Input should be a JSON object": b"[1, 2]",
        "is not UTF-8": b"\xff\xfe\xfa",
        "unknown key": line(time=3),
        "metadata 'systematic_rotation_rad'": line(metadata={"systematic_rotation_rad": "much"}),
        "given twice": b'{"frame": 7, "frame": 7, "cameras": {}}',
        "differ in length": b'{"frame": 7, "cameras": {"left": {"u_px": [1], "v_px": [],'
        b' "x_m": [], "y_m": [], "z_m": []}}}',
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
    said = left_out(err)
    assert len(said) == len(wrong) + 1
    for line, what in zip(said, (*wrong, "is not JSON"), strict=True):
        assert what in line
    assert "Traceback" not in err


def test_a_refused_update_changes_neither_the_tracker_nor_the_disk(
    world: World, tmp_path: Path
) -> None:
    good = world.tables[7]
    stamps = np.full(len(good), 5, np.int64)
    wrong = (
        world.tables[3],
        world.tables[6],
        replace(good, cameras=("left", "stranger")),
        concatenate([good, world.tables[8]]),
        good.select(slice(0, 0)),
        replace(good, stamp_ns=stamps),
        replace(good, metadata={"of": object()}),
        replace(good, metadata={"of": np.float32(1)}),
    )
    with DurableCalibrator(tmp_path, world.guess) as calibrator:
        for table in world.tables[:6]:
            calibrator.update(table)
        calibrator.update(replace(world.tables[6], stamp_ns=stamps[: len(world.tables[6])]))
        before = calibrator.tracker.to_bytes(), files_in(tmp_path)
        for table in wrong:
            with pytest.raises(CorrespondenceError):
                calibrator.update(table)
            assert (calibrator.tracker.to_bytes(), files_in(tmp_path)) == before
        with pytest.raises(CorrespondenceError, match="is of frame 7, not 9"):
            calibrator.update(good, frame=9)
        assert calibrator.update(good, frame=np.int64(7)).frame == 7


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def degenerate(number: int, good: Correspondences, rng: np.random.Generator) -> Correspondences:
    """A frame that is well formed and says nothing, or nonsense."""
    n = len(good)
    line = np.outer(np.linspace(5, 20, n), [1.0, 0.1, 0.05])
    kinds: tuple[Callable[[], Correspondences], ...] = (
        lambda: good.select(slice(0, 0)),
        lambda: good.select(np.zeros(n, np.intp)),
        lambda: good.select(rng.permutation(n)[: rng.integers(1, 14)]),
        lambda: replace(good, points_lidar_m=np.tile(good.points_lidar_m[:1], (n, 1))),
        lambda: replace(good, points_lidar_m=line),
        lambda: replace(good, points_lidar_m=-good.points_lidar_m),
        lambda: replace(good, points_lidar_m=line / line.max() * 999_999),
        lambda: replace(good, points_lidar_m=good.points_lidar_m * [1, 1, 0]),
        lambda: replace(good, points_lidar_m=np.zeros((n, 3))),
        lambda: replace(good, pixels_px=np.tile(good.pixels_px[:1], (n, 1))),
        lambda: replace(good, pixels_px=rng.uniform(-9e5, 9e5, (n, 2))),
        lambda: replace(good, pixels_px=good.pixels_px + rng.uniform(-300, 300, 2)),
        lambda: replace(good, confidence=np.full(n, 1e-30, np.float32)),
        lambda: replace(good, confidence=np.ones(n, np.float32)),
        lambda: replace(good, information_px=np.tile([1.0, 0.0, 0.0], (n, 1))),
        lambda: replace(good, information_px=np.tile([1e-6, 0.0, 1e6], (n, 1))),
        lambda: replace(good, metadata={"systematic_rotation_rad": 1e-300}),
    )
    return kinds[number % len(kinds)]()


@pytest.mark.parametrize(
    ("kind", "share"),
    [
        ("pair", 0.4),
        ("pair", 1.0),
        ("one", 0.4),
        ("one", 1.0),
        ("fisheye", 0.4),
        ("fisheye", 1.0),
        ("tied", 0.4),
        ("tied", 1.0),
    ],
)
def test_nonsense_neither_throws_nor_harms(kind: str, share: float) -> None:
    """Warnings are errors here: no division by zero either."""
    tied = pair_of()
    rig = {
        "pair": pair_of(),
        "one": Rig(cameras={"only": make_camera()}),
        "fisheye": pair_of(model="fisheye", distortion=KANNALA),
        "tied": tied.model_copy(update={"relative_poses": (stereo_relative_pose(tied),)}),
    }[kind]
    rng = np.random.default_rng(3)
    tracker = IncrementalCalibrator(perturb(rig, rotation_deg=1, translation_m=0.1, seed=3))
    for frame, good in enumerate(drive(rig, 70)):
        table = degenerate(frame // 2, good, rng) if rng.random() < share else good
        line = json_line(tracker.update(table, frame=frame))
    again = IncrementalCalibrator.from_bytes(tracker.to_bytes())
    assert again.to_bytes() == tracker.to_bytes()
    for name, camera in json.loads(line)["cameras"].items():
        turn = np.array(camera["T_camera_lidar"]) @ np.linalg.inv(rig.T_camera_lidar[name])
        angle = np.degrees(np.arccos(np.clip((np.trace(turn[:3, :3]) - 1) / 2, -1, 1)))
        # 0.1 deg: ten times the sigma of forty frames of 60 matches. Nonsense alone may agree.
        assert angle < 0.1 or share == 1.0


def test_the_joint_covariance_of_tied_cameras_has_no_negative_variance() -> None:
    pair = pair_of()
    tied = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    tracker = IncrementalCalibrator(perturb(tied, rotation_deg=1, translation_m=0.1, seed=3))
    for table in drive(tied, 30, failed_share=0.2):
        tracker.update(table)
        joint = tracker.calibration().joint_covariance
        if joint is not None:  # of few frames it is singular, up to rounding
            values = np.linalg.eigvalsh(joint)
            assert values[0] > -1e-12 * values[-1]


def test_frames_of_wildly_different_information_do_not_throw() -> None:
    tracker = IncrementalCalibrator(pair_of())
    for frame, table in enumerate(drive(pair_of(), 30)):
        size = 9e7 if frame % 7 == 6 else 1.0
        tracker.update(replace(table, information_px=np.tile([size, 0, size], (len(table), 1))))
    with pytest.raises(CorrespondenceError, match="information must be finite and below 1e"):
        replace(table, information_px=np.tile([1e9, 0, 1e9], (len(table), 1)))


# Sources that hold nothing, and standard streams that are closed


def test_an_empty_source_is_told_in_one_line(
    world: World, call: Call, piped: Callable[..., Any], tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    (tmp_path / "folder").mkdir()
    concatenate(world.tables).select(slice(0, 0)).save(tmp_path / "empty.parquet")
    for code, text, err in (
        piped(world.rig, b"", *out),
        call("track", world.rig, tmp_path / "folder", *out),
        call("track", world.rig, tmp_path / "missing.parquet", *out),
    ):
        assert (code, text) == (2, "")
        assert err.startswith("calibgraph: ") and err.count("\n") == 1
    code, text, err = call("track", world.rig, tmp_path / "empty.parquet", *out)
    assert (code, text) == (2, "")
    assert err.splitlines()[-1].endswith("held no frame that could be used (1 left out); check it")


@pytest.mark.parametrize("which", ["stdin", "stdout"])
def test_a_closed_standard_stream_is_told_in_one_line(
    which: str, world: World, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, which, None)
    code, _, err = call("track", world.rig, "-", "--out", tmp_path / "out")
    assert code == 2
    assert err.startswith(f"calibgraph: standard {which.removeprefix('std')}put: is closed")
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


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
    assert code == 0 and out.splitlines() == world.lines[1:]


def test_a_full_disk_under_standard_output_is_told_in_one_line(
    world: World, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with open("/dev/full", "w") as full, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", full)
        code, _, err = call("track", world.rig, world.source, "--out", tmp_path / "out")
    assert code == 2
    assert err.startswith("calibgraph: standard output: cannot be written to")
    _, out, _ = call("track", world.rig, world.source, "--out", tmp_path / "out")
    assert out.splitlines() == world.lines


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


def test_a_signal_before_the_first_frame_is_no_error(
    world: World, piped: Callable[..., Any], tmp_path: Path
) -> None:
    feed = Feed([], 0, lambda: signal.raise_signal(signal.SIGTERM))
    code, out, err = piped(world.rig, feed, "--out", tmp_path / "out")
    assert (code, out) == (1, "")  # the verdict without an estimate is FAIL
    assert "Traceback" not in err


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
            patch.setattr(command, "_write_line", write)
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

    monkeypatch.setattr(command, "_write_line", write)
    concatenate(world.tables[:7]).save(folder / "1.parquet")
    code, _, _ = call("track", world.rig, folder, "--follow", "--out", tmp_path / "out")
    assert code == 0 and given == world.lines


# State


def test_a_folder_in_use_is_refused_in_one_line(world: World, call: Call, tmp_path: Path) -> None:
    with DurableCalibrator(tmp_path / "state", world.guess):
        code, out, err = call("track", world.rig, world.source, "--out", tmp_path)
    assert (code, out) == (2, "")
    assert "is in use by another process" in err and err.count("\n") == 1


def test_a_state_of_another_rig_or_config_is_refused_in_one_line(
    world: World, call: Call, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    call("track", world.rig, world.source, *out)
    before = files_in(tmp_path / "out" / "state")
    pair_of(model="fisheye", distortion=KANNALA).save(tmp_path / "other.yaml")
    (tmp_path / "config.yaml").write_text("tracking: {epoch_frames: 7}\n")
    for arguments, said in (
        ((tmp_path / "other.yaml", world.source), "another rig"),
        ((world.rig, world.source, "--config", tmp_path / "config.yaml"), "other settings"),
    ):
        code, text, err = call("track", *arguments, *out)
        assert (code, text) == (2, "")
        assert said in err and str(tmp_path) in err and err.count("\n") == 1
        assert files_in(tmp_path / "out" / "state") == before
    moved = perturb(world.guess, rotation_deg=1, translation_m=0.1, seed=9)
    moved.save(tmp_path / "moved.yaml")  # another guess of the same rig is no other rig
    code, text, _ = call("track", tmp_path / "moved.yaml", world.source, *out)
    assert (code, text) == (0, "")


def test_a_damaged_snapshot_is_named_and_costs_nothing(
    world: World, call: Call, tmp_path: Path
) -> None:
    concatenate(world.tables[:8]).save(tmp_path / "begin.parquet")
    call("track", world.rig, tmp_path / "begin.parquet", "--out", tmp_path / "out")
    path = tmp_path / "out" / "state" / DATABASE
    with closing(sqlite3.connect(path, isolation_level=None)) as database:
        database.execute(
            "UPDATE snapshot SET digest = zeroblob(32)"
            " WHERE number = (SELECT max(number) FROM snapshot)"
        )
    code, out, err = call("track", world.rig, world.source, "--out", tmp_path / "out")
    assert code == 0
    # What was before the damage is taken from the snapshot before and the journal.
    assert out.splitlines() == world.lines[7:]
    assert [line for line in err.splitlines() if line.startswith("warning: ")] == [
        f"warning: {path}: the snapshot after update 8 is damaged: not used"
    ]


def test_a_damaged_database_is_refused_in_one_line(
    world: World, call: Call, tmp_path: Path
) -> None:
    call("track", world.rig, world.source, "--out", tmp_path)
    path = tmp_path / "state" / DATABASE
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    before = files_in(tmp_path / "state")
    code, out, err = call("track", world.rig, world.source, "--out", tmp_path)
    assert (code, out) == (2, "")
    assert f"{path}: is damaged" in err and "choose another folder" in err
    assert err.count("\n") == 1
    assert files_in(tmp_path / "state") == before


def test_a_state_of_the_earlier_layout_is_refused_in_one_line(
    world: World, call: Call, tmp_path: Path
) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "state" / "snapshot-000001.state").write_bytes(b"calibgraph-tracker/1\nS")
    code, out, err = call("track", world.rig, world.source, "--out", tmp_path)
    assert (code, out) == (2, "")
    assert "is state of the earlier layout" in err and "choose another folder" in err
    assert err.count("\n") == 1


def test_a_state_of_another_version_is_refused_in_one_line(
    world: World, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(IncrementalCalibrator, "to_bytes", lambda self: b"other")
        call("track", world.rig, world.source, "--out", tmp_path)
    code, _, err = call("track", world.rig, world.source, "--out", tmp_path)
    assert code == 2
    assert "holds a state of another version" in err and err.count("\n") == 1


def test_a_counter_that_starts_anew_is_told(
    world: World, piped: Callable[..., Any], tmp_path: Path
) -> None:
    later = [replace(table, frame=table.frame + 100) for table in world.tables]
    piped(world.rig, as_lines(later), "--out", tmp_path)
    _, out, err = piped(world.rig, as_lines(world.tables), "--out", tmp_path)
    assert out == ""
    assert "frame 0 and others up to 113 are known: skipped" in err
    assert f"{FRAMES} known from before" in err


class Crashed(BaseException):
    """As good as a kill: nothing is saved on the way out."""


@pytest.mark.parametrize("at", [0, 4, 9, 10, 13])
def test_after_a_crash_the_last_line_comes_again(
    at: int, world: World, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Between the disk and the line: the line was not printed. The snapshots are every 5 frames."""
    monkeypatch.setattr(durable, "_SNAPSHOT_EVERY", 5)
    given: list[str] = []

    def write(line: str) -> None:
        if len(given) == at:
            raise Crashed
        given.append(line)

    with monkeypatch.context() as patch:
        patch.setattr(command, "_write_line", write)
        with pytest.raises(Crashed):
            call("track", world.rig, world.source, "--out", tmp_path)
    code, out, err = call("track", world.rig, world.source, "--out", tmp_path)
    assert code == 0
    assert given + out.splitlines() == world.lines
    assert f"{FRAMES - at - 1} updates" in err


def test_a_full_disk_under_the_state_is_told_in_one_line_and_costs_nothing(
    world: World, call: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    append = StateDatabase.append

    def full(database: StateDatabase, record: bytes) -> None:
        if len(left) == 0:
            raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path))
        left.pop()
        append(database, record)

    left = [0] * 6
    with monkeypatch.context() as patch:
        patch.setattr(StateDatabase, "append", full)
        code, first, err = call("track", world.rig, world.source, "--out", tmp_path)
    assert code == 2
    assert err.splitlines()[-1] == f"calibgraph: {tmp_path}: No space left on device"
    _, second, _ = call("track", world.rig, world.source, "--out", tmp_path)
    again = first.splitlines()[-1]
    assert first.splitlines() + second.splitlines() == [*world.lines[:5], again, *world.lines[5:]]


def test_a_tracker_that_throws_leaves_the_state_as_it_was(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever an update may raise: half of it must not get into a snapshot."""
    rig = world.guess
    with pytest.raises(ZeroDivisionError), DurableCalibrator(tmp_path, rig) as calibrator:  # noqa: PT012
        for table in world.tables[:7]:
            calibrator.update(table)
        before = calibrator.tracker.to_bytes()
        with monkeypatch.context() as patch:
            patch.setattr(IncrementalCalibrator, "_report", lambda *_: 1 / 0)
            calibrator.update(world.tables[7])
    with DurableCalibrator(tmp_path, rig) as calibrator:
        assert calibrator.tracker.to_bytes() == before
        assert json_line(calibrator.update(world.tables[7])) == world.lines[7]


# Datasets


@dataclass
class Given:
    """A matcher that finds a table's rows, worse ones in its first round."""

    table: Correspondences
    unreadable: tuple[int, ...] = ()
    rounds: int = 2
    stage1: Literal["pnp", "rig"] = "pnp"

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: object
    ) -> Correspondences:
        frames = [frame.index for frame in dataset.frames]
        for number in frames:
            if number in self.unreadable:
                raise DatasetError(f"image {number} is truncated", frame=number)
        # What it finds depends on where it starts from, as with any matcher.
        shift = 10.0 * rig.T_camera_lidar["left"][0, 3]
        found = self.table.select(np.isin(self.table.frame, frames))
        return replace(found, pixels_px=found.pixels_px + 0.01 * shift + 0.1 * (1 - round_index))


@pytest.fixture
def recorded(world: World, tmp_path: Path) -> Dataset:
    folder = tmp_path / "data"
    for number in range(FRAMES):
        for place in ("cameras/left", "cameras/right", "lidar"):
            suffix = ".npy" if place == "lidar" else ".png"
            path = folder / place / f"{number:03d}{suffix}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"")
    shutil.copy(world.rig, folder / "rig.yaml")
    return load_dataset(folder)


@pytest.mark.parametrize("at", [0, 3, 8])
def test_a_dataset_goes_on_after_a_crash_and_around_an_unreadable_frame(
    at: int,
    world: World,
    recorded: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A crash among the first frames, which are matched as a batch, or after them."""
    matcher = Given(concatenate(world.tables), unreadable=(7,))

    def lines(out: Path, crash: int | None) -> tuple[list[str], list[str]]:
        given: list[str] = []
        said: list[str] = []

        def write(line: str) -> None:
            if len(given) == crash:
                raise Crashed
            given.append(line)

        monkeypatch.setattr(command, "_write_line", write)
        wanted = Tracking(rig=recorded.rig, config=Config(), out=out, matcher=matcher)
        try:
            track(wanted, recorded.folders, notify=said.append)
        except Crashed:
            assert crash is not None
        return given, said

    whole, said = lines(tmp_path / "whole", None)
    assert [json.loads(line)["frame"] for line in whole] == [f for f in range(FRAMES) if f != 7]
    assert [s for s in said if s.startswith("left out")] == [
        "left out: frame 007 (7): image 7 is truncated"
    ]
    first, _ = lines(tmp_path / "crashed", at)
    second, _ = lines(tmp_path / "crashed", None)
    assert first + second == whole


@pytest.mark.statistics
def test_the_structure_matcher_goes_on_after_kills_and_around_corrupt_files(
    tmp_path: Path,
) -> None:
    """The sample and three frames more: an image cut short, an empty image, a cloud cut short."""
    data = tmp_path / "data"
    shutil.copytree(SAMPLE, data)
    places = [*(data / "cameras").iterdir(), data / "lidar"]
    for place in places:
        for path in sorted(place.iterdir())[:4]:
            shutil.copy(path, path.with_stem(f"{int(path.stem) + 6:06d}"))
    for path, size in (
        (data / "cameras" / "left" / "000006.jpg", 500),
        (data / "cameras" / "left" / "000007.jpg", 0),
        (data / "lidar" / "000008.npy", 60),
    ):
        path.write_bytes(path.read_bytes()[:size])
    arguments = [str(data), str(data), "--matcher", "structure", "--out"]
    whole = Killed(arguments + [str(tmp_path / "whole")], tmp_path / "whole.jsonl")
    assert whole.run(None)
    assert [json.loads(line)["frame"] for line in whole.lines] == [0, 1, 2, 3, 4, 5, 9]
    killed = Killed(arguments + [str(tmp_path / "killed")], tmp_path / "killed.jsonl")
    for count in (1, 3, 5, 6):
        killed.run(lambda done=count: len(set(killed.lines)) >= done)
    assert killed.run(None)
    assert killed.acknowledged() == whole.lines


# Kills


def _command(arguments: list[str], lines: Path, snapshot_every: int) -> None:
    """In a process of its own: ``track`` with standard output appended to a file."""
    for descriptor, path in ((1, lines), (2, lines.with_suffix(".err"))):
        file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
        os.dup2(file, descriptor)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    durable._SNAPSHOT_EVERY = snapshot_every
    History.draw = lambda self, path: path.write_bytes(b"")  # type: ignore[method-assign]
    sys.argv = ["calibgraph", "track", *arguments]
    app.main()


@dataclass
class Killed:
    """A command that is killed and started again, and the lines that it printed in between."""

    arguments: list[str]
    path: Path
    snapshot_every: int = 7

    def run(self, when: Callable[[], bool] | None) -> bool:
        """Start it, and kill it when that is so; whether it ended by itself, and well."""
        self._cut_half_a_line()
        before = self.lines
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(
            ["tests.tracking.test_command", "pyarrow.parquet", "calibgraph.cli.tables"]
        )
        process = context.Process(
            target=_command, args=(self.arguments, self.path, self.snapshot_every)
        )
        process.start()
        while process.is_alive() and not (when is not None and when()):
            process.join(0.002)
        process.kill()
        process.join()
        if before and (after := self.lines[len(before) :]):
            last, first = frames_in(before[-1])[0], frames_in(after[0])[0]
            assert first >= last, "an update that was acknowledged is lost"
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
        """The lines, the ones that came again once: they must be the same to the last digit."""
        lines = self.lines
        return [line for line, before in zip(lines, [None, *lines], strict=False) if line != before]

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


@pytest.mark.slow
def test_random_kills_lose_nothing_and_change_nothing(tmp_path: Path) -> None:
    assert kill_often(tmp_path, kills=5, longest_s=0.6, seed=int.from_bytes(os.urandom(4))) >= 1


@pytest.mark.statistics
def test_forty_random_kills_under_load_lose_nothing_and_change_nothing(
    tmp_path: Path,
) -> None:
    spin = "while True: pass"
    load = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(os.cpu_count() or 1)]
    try:
        kill_often(tmp_path, kills=40, longest_s=1.0, seed=int.from_bytes(os.urandom(4)))
    finally:
        for process in load:
            process.kill()
            process.wait()


# Back-pressure


@pytest.fixture
def running(world: World, tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    arguments = [world.rig, "-", "--out", tmp_path / "out"]
    program = "from calibgraph.cli import app; app.main()"
    with subprocess.Popen(
        [sys.executable, "-c", program, "track", *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        yield process
        process.kill()


@pytest.mark.slow
def test_a_slow_reader_slows_an_endless_writer_down_in_constant_memory(
    world: World, running: subprocess.Popen[bytes]
) -> None:
    """Between the two are pipes of 64 kB each, a chunk of 64 kB, and the frame at hand."""
    assert running.stdin is not None and running.stdout is not None
    sent = [0]

    def write_endlessly() -> None:
        assert running.stdin is not None
        try:
            for number in range(10**9):
                table = world.tables[number % FRAMES]
                table = replace(table, frame=np.full(len(table), number))
                sent[0] += running.stdin.write(as_lines([table]))
                running.stdin.flush()
        except OSError:  # it has ended
            return

    def memory_kb() -> int:
        status = Path(f"/proc/{running.pid}/status").read_text()
        return int(next(s.split()[1] for s in status.splitlines() if s.startswith("VmRSS")))

    def settled() -> int:
        """Bytes sent, once no more are taken."""
        before, quiet = -1, 0
        while quiet < 6:
            quiet = quiet + 1 if sent[0] == before else 0
            before = sent[0]
            time.sleep(0.1)
        return before

    writer = threading.Thread(target=write_endlessly)
    writer.start()
    running.stdout.readline()
    held = settled()
    memory = memory_kb()
    taken = sum(len(running.stdout.readline()) for _ in range(100))
    assert taken > 100_000
    # What was printed and not read: 64 kB are some 30 frames of 10 kB each.
    assert settled() - held < 2_500_000
    assert memory_kb() - memory < 50_000
    running.send_signal(signal.SIGTERM)
    rest = running.stdout.read()
    assert running.wait() in (0, 1)
    assert all(json.loads(line) for line in rest.splitlines())
    writer.join()
