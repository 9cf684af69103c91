"""A tracker on disk: crashes, damage, other rigs, a full disk, and files of others."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibgraph import (
    CorrespondenceError,
    DurableCalibrator,
    FileError,
    IncrementalCalibrator,
    Rig,
    concatenate,
    perturb,
)
from calibgraph.tracking import durable, tracker
from calibgraph.tracking.assessment import json_lines
from calibgraph.tracking.durable import DATABASE, StateDatabase
from calibgraph.tracking.frames import StreamFrame
from tests.conftest import KANNALA, Call
from tests.tracking.drives import World, drive_at, moved, pair_of, step_of

pytestmark = pytest.mark.usefixtures("not_warmed_up")


def test_a_refused_update_changes_neither_the_tracker_nor_the_disk(
    world: World, tmp_path: Path
) -> None:
    good = world.tables[7]
    wrong = (
        (world.tables[3], "comes after frame 6"),
        (world.tables[6], "comes again"),
        (replace(good, cameras=("left", "stranger")), "'stranger'"),
        (concatenate([good, world.tables[8]]), "one"),
        (good.select(slice(0, 0)), "which frame"),
        (replace(good, metadata={"place": 1.5}), "place"),
        (replace(good, metadata={"place": "\ud800"}), "place"),
    )
    with DurableCalibrator(tmp_path, world.guess) as calibrator:
        for table in world.tables[:7]:
            calibrator.update(table)
        before = calibrator.tracker.to_bytes()
        for table, reason in wrong:
            with pytest.raises(CorrespondenceError, match=reason):
                calibrator.update(table)
            assert calibrator.tracker.to_bytes() == before
        with pytest.raises(CorrespondenceError, match=r"rows of \[7\] for 9"):
            calibrator.update(good, frame=9)
        for number in (2**63, -(2**63) - 1, 2**70, 10**5000, np.uint64(2**64 - 1)):
            with pytest.raises(CorrespondenceError, match="must have at most 63 bits, found"):
                calibrator.update(good.select(slice(0, 0)), frame=number)
        for place in ("\ud800", "half \udfff", "\0"):
            with pytest.raises(CorrespondenceError, match="place of a frame must have .*found '"):
                calibrator.update(good, place=place)
        assert calibrator.tracker.to_bytes() == before
        assert calibrator.update(good, frame=np.int64(7)).frame == 7
    with DurableCalibrator(tmp_path, world.guess) as calibrator:
        assert json_lines([calibrator.update(world.tables[8])]) == [world.lines[8]]


def test_a_state_of_another_rig_or_config_is_refused_in_one_line(
    world: World, call: Call, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    call("track", world.rig, world.source, *out)
    pair_of(model="fisheye", distortion=KANNALA).save(tmp_path / "other.yaml")
    (tmp_path / "config.yaml").write_text("tracking: {epoch_frames: 7}\n")
    for arguments, reason in (
        ((tmp_path / "other.yaml", world.source), "another rig"),
        (
            (world.rig, world.source, "--config", tmp_path / "config.yaml"),
            "(epoch_frames 10, given 7)",
        ),
    ):
        code, text, err = call("track", *arguments, *out)
        assert (code, text) == (2, "")
        assert reason in err and str(tmp_path) in err and err.count("\n") == 1
    moved = perturb(world.guess, rotation_deg=1, translation_m=0.1, seed=9)
    moved.save(tmp_path / "moved.yaml")  # another guess of the same rig is no other rig
    code, text, _ = call("track", tmp_path / "moved.yaml", world.source, *out)
    assert (code, text) == (0, "")


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
            patch.setattr(tracker, "make_updates", lambda *_, **__: 1 / 0)
            calibrator.update(world.tables[7])
    with DurableCalibrator(tmp_path, rig) as calibrator:
        assert calibrator.tracker.to_bytes() == before
        assert json_lines([calibrator.update(world.tables[7])]) == [world.lines[7]]


@pytest.mark.parametrize("updates", [4, 5, 6, 11])
def test_a_kill_around_the_write_of_a_state_costs_nothing(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, updates: int
) -> None:
    """It is written with the first update after every fifth; the last update comes again."""
    monkeypatch.setattr(durable, "_STATE_EVERY", 5)
    calibrator = DurableCalibrator(tmp_path / "state", world.guess)
    for table in world.tables[:updates]:
        calibrator.update(table)
    shutil.copytree(tmp_path / "state", tmp_path / "copy")  # as a kill leaves it
    with DurableCalibrator(tmp_path / "copy", world.guess) as resumed:
        found = [*resumed.repeated, *map(resumed.update, world.tables[updates:])]
    assert json_lines(found) == world.lines[updates - 1 :]
    calibrator.close()


def test_frames_of_one_write_come_again_in_the_groups_they_came_in(
    world: World, tmp_path: Path
) -> None:
    """Groups end where a camera starts, an epoch ends, or a frame is refused."""
    frames = [StreamFrame(int(table.frame[0]), table) for table in world.tables]
    frames.insert(7, frames[2])
    calibrator = DurableCalibrator(tmp_path / "state", world.guess)
    found = calibrator.update_all(frames)
    assert [type(one) for one in found].count(CorrespondenceError) == 1
    shutil.copytree(tmp_path / "state", tmp_path / "copy")
    updates = [update for one in found if isinstance(one, list) for update in one]
    with DurableCalibrator(tmp_path / "copy", world.guess) as resumed:
        assert json_lines(resumed.repeated) == json_lines(updates)
        assert resumed.tracker.to_bytes() == calibrator.tracker.to_bytes()
    calibrator.close()


def test_a_saved_tracker_continues_with_the_same_numbers(pair: Rig, tmp_path: Path) -> None:
    """Saved while starting, between epochs, within one, with outlier frames, after a step.

    An epoch has 10 frames: each goes on to the end of the one after it.
    """
    after = moved(pair, "left", step_of(0.5, 3))
    tables = drive_at(lambda frame: after if frame >= 42 else pair, 56, failed_share=0.1)
    tracker, whole = IncrementalCalibrator(pair), []
    for frame, table in enumerate(tables):
        if frame in (3, 5, 29, 43, 50):
            tracker.save(tmp_path / str(frame))
        whole.append(tracker.update(table))
    for saved in tmp_path.iterdir():
        resumed, cut = IncrementalCalibrator.load(saved), int(saved.name)
        for table, expected in zip(tables[cut : cut + 12], whole[cut : cut + 12], strict=True):
            found = resumed.update(table)
            assert found.events == expected.events and found.verdicts == expected.verdicts
            for name, T in expected.T_camera_lidar.items():
                np.testing.assert_array_equal(found.T_camera_lidar[name], T)
                np.testing.assert_array_equal(found.covariance[name], expected.covariance[name])


def test_bytes_that_are_damaged_or_of_another_version_are_refused(
    pair: Rig, tmp_path: Path
) -> None:
    data = IncrementalCalibrator(pair).to_bytes()
    for wrong, why in (
        (b"", "is of another version"),
        (data.replace(b"tracker/", b"tracker/9"), "begins with 'calibgraph-tracker/9"),
        (data[:-1], "is damaged"),
        (data[:-1] + b"x", "is damaged"),
    ):
        (tmp_path / "saved").write_bytes(wrong)
        with pytest.raises(FileError, match=why) as error:
            IncrementalCalibrator.load(tmp_path / "saved")
        assert "\n" not in str(error.value)


# The database


def test_every_commit_is_synced(tmp_path: Path) -> None:
    """What the guarantee against power cuts rests on, by SQLite's documentation."""
    with closing(StateDatabase(tmp_path)) as database:
        for pragma, expected in (
            ("journal_mode", "wal"), ("synchronous", 2), ("locking_mode", "exclusive"),
        ):  # fmt: skip
            found = database._connection.execute(f"PRAGMA {pragma}").fetchone()
            assert found == (expected,), pragma


def test_the_folder_does_not_grow_with_the_number_of_states(tmp_path: Path) -> None:
    with closing(StateDatabase(tmp_path)) as database:
        for _ in range(60):
            database.write([os.urandom(10_000)])
            database.write([], os.urandom(100_000))
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 1_000_000


ACKNOWLEDGING = """
import os, random, sys
from pathlib import Path
from calibgraph.tracking.durable import StateDatabase

database = StateDatabase(Path(sys.argv[1]))
lines = b"\\n".join(database.read()).splitlines()
while True:
    line = b"%d %s" % (len(lines), b"x" * random.randrange(50_000))
    state = b"\\n".join(lines) if random.random() < 0.2 and lines else None
    database.write([line], state)
    lines.append(line)
    os.write(1, b"%d\\n" % (len(lines) - 1))
"""


@pytest.mark.ci
@pytest.mark.slow
def test_every_input_acknowledged_before_a_sigkill_is_there(tmp_path: Path) -> None:
    rng, acknowledged = np.random.default_rng(5), 0
    for _ in range(int(os.environ.get("CALIBGRAPH_TEST_KILLS", "2"))):
        command = [sys.executable, "-c", ACKNOWLEDGING, str(tmp_path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            for _ in range(rng.integers(1, 40)):
                acknowledged = int(process.stdout.readline())
            process.send_signal(signal.SIGKILL)
            acknowledged = int([acknowledged, *process.stdout.read().split()][-1])
        with closing(StateDatabase(tmp_path)) as database:
            lines = b"\n".join(database.read()).splitlines()
        assert [int(line.split()[0]) for line in lines] == [*range(len(lines))]
        assert len(lines) in (acknowledged + 1, acknowledged + 2)


@pytest.mark.parametrize(
    ("statement", "match"),
    [
        ("UPDATE kept SET content = x'00' WHERE number = 1", "damaged or of another version"),
        ("UPDATE kept SET content = x'00' WHERE number = 2", "damaged or of another version"),
        ("PRAGMA user_version=3", "is of another program or version; choose another folder"),
        ("CREATE TRIGGER t AFTER INSERT ON kept BEGIN DELETE FROM kept; END", "another program"),
        ("DROP TABLE kept; CREATE TABLE theirs (number INTEGER)", "another program"),
        ("PRAGMA writable_schema=ON; UPDATE sqlite_schema SET rootpage = 9", "is damaged"),
    ],
)
def test_damaged_rows_and_databases_of_others_are_refused(
    world: World, tmp_path: Path, statement: str, match: str
) -> None:
    held = DurableCalibrator(tmp_path, world.guess)
    for table in world.tables[:2]:
        held.update(table)
    held.abandon()
    with closing(sqlite3.connect(tmp_path / DATABASE, isolation_level=None)) as database:
        database.executescript(statement)
    with pytest.raises(FileError, match=match) as refused:
        DurableCalibrator(tmp_path, world.guess)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("is_cut", [False, True])
def test_a_file_that_is_cut_or_spoilt_is_refused_in_one_line(
    tmp_path: Path, share: float, is_cut: bool
) -> None:
    with DurableCalibrator(tmp_path, pair_of()) as held:
        for table in drive_at(lambda _: pair_of(), 2):
            held.update(table)
    data = bytearray((tmp_path / DATABASE).read_bytes())
    at = int(share * len(data))
    data[at:] = bytes(len(data) - at)
    (tmp_path / DATABASE).write_bytes(data[:at] if is_cut else data)
    with pytest.raises(FileError, match="damaged") as refused:
        DurableCalibrator(tmp_path, pair_of())
    assert "\n" not in str(refused.value)


def test_two_cannot_have_one_folder_nor_a_file_be_one(tmp_path: Path) -> None:
    in_use = pytest.raises(FileError, match="is in use by another process; stop that one")
    with closing(StateDatabase(tmp_path / "state")), in_use:
        StateDatabase(tmp_path / "state")
    StateDatabase(tmp_path / "state").close()
    with pytest.raises(FileError, match="expected a folder"):
        StateDatabase(tmp_path / "state" / DATABASE)


@contextmanager
def file_size_limit(limit_bytes: int) -> Iterator[None]:
    """The system lets no file grow beyond a size, as if the disk were full."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("room", [0, 5_000, 50_000])
@pytest.mark.parametrize("state", [None, bytes(300_000)])
def test_a_full_disk_is_named_and_costs_nothing(
    tmp_path: Path, room: int, state: bytes | None
) -> None:
    with closing(StateDatabase(tmp_path)) as database:
        database.write([b"first"], b"begin")
        size = max(path.stat().st_size for path in tmp_path.iterdir())
        with file_size_limit(size + room):
            for wanted in ("free or mend the disk and start again", "cannot be written"):
                with pytest.raises(OSError, match=wanted) as error:
                    database.write([bytes(100_000)], state)
                assert error.value.filename == str(tmp_path / DATABASE)
    with closing(StateDatabase(tmp_path)) as database:
        assert database.read() == [b"begin", b"first"]
