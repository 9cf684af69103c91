"""A tracker on disk: crashes, damage, other rigs, a full disk, and bytes that are no state."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from hashlib import sha256
from pathlib import Path

import msgpack
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
from calibgraph.tracking.state_bytes import Kind, encode
from calibgraph.tracking.state_database import DATABASE, StateDatabase
from tests.conftest import KANNALA, Call
from tests.tracking.drives import (
    World,
    drive_at,
    file_lines,
    files_in,
    moved,
    pair_of,
    step_of,
)

pytestmark = pytest.mark.usefixtures("no_picture")


def test_a_refused_update_changes_neither_the_tracker_nor_the_disk(
    world: World, tmp_path: Path
) -> None:
    good = world.tables[7]
    stamps = np.full(len(good), 5, np.int64)
    wrong = (
        (world.tables[3], "comes after frame 6"),
        (world.tables[6], "comes again"),
        (replace(good, cameras=("left", "stranger")), "'stranger'"),
        (concatenate([good, world.tables[8]]), "one"),
        (good.select(slice(0, 0)), "which frame"),
        (replace(good, stamp_ns=stamps), "stamp_ns 5 is not after 5"),
        (replace(good, metadata={"place": 1.5}), "place"),
        (replace(good, metadata={"place": "\ud800"}), "place"),
        (replace(good, cameras=("left", "right", "\ud800")), "camera"),
    )
    with DurableCalibrator(tmp_path, world.guess) as calibrator:
        for table in world.tables[:6]:
            calibrator.update(table)
        calibrator.update(replace(world.tables[6], stamp_ns=stamps[: len(world.tables[6])]))
        before = calibrator.tracker.to_bytes(), files_in(tmp_path)
        for table, reason in wrong:
            with pytest.raises(CorrespondenceError, match=reason):
                calibrator.update(table)
            assert (calibrator.tracker.to_bytes(), files_in(tmp_path)) == before
        with pytest.raises(CorrespondenceError, match="is of frame 7, not 9"):
            calibrator.update(good, frame=9)
        for number in (2**63, -(2**63) - 1, 2**70, 10**5000, np.uint64(2**64 - 1)):
            with pytest.raises(CorrespondenceError, match="must have at most 63 bits, found"):
                calibrator.update(good.select(slice(0, 0)), frame=number)
        for place in ("\ud800", "half \udfff", "\0"):
            with pytest.raises(CorrespondenceError, match="place of a frame must have .*found '"):
                calibrator.update(good, place=place)
        assert (calibrator.tracker.to_bytes(), files_in(tmp_path)) == before
        assert calibrator.update(good, frame=np.int64(7)).frame == 7


def test_a_state_of_another_rig_or_config_is_refused_in_one_line(
    world: World, call: Call, tmp_path: Path
) -> None:
    out = ("--out", tmp_path / "out")
    call("track", world.rig, world.source, *out)
    before = files_in(tmp_path / "out" / "state")
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
    lines = file_lines(world.guess, world.tables[:8], world.tables[8:])
    assert out.splitlines() == lines[5:]  # the last input before had three frames
    assert [line for line in err.splitlines() if line.startswith("warning: ")] == [
        f"warning: {path}: the snapshot after input 6 is damaged: not used"
    ]


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


@pytest.mark.parametrize("updates", [5, 6, 7, 11, 12])
def test_a_kill_before_and_after_a_snapshot_is_written_costs_nothing(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, updates: int
) -> None:
    """It is encoded at every 5th update and written with the next one."""
    monkeypatch.setattr(durable, "_SNAPSHOT_EVERY", 5)
    calibrator = DurableCalibrator(tmp_path / "state", world.guess)
    for table in world.tables[:updates]:
        calibrator.update(table)
    shutil.copytree(tmp_path / "state", tmp_path / "copy")  # as a kill leaves it
    with DurableCalibrator(tmp_path / "copy", world.guess) as resumed:
        assert resumed.repeated and resumed.damages == ()
        found = [resumed.repeated[-1], *map(resumed.update, world.tables[updates:])]
    assert json_lines(found) == world.lines[updates - 1 :]
    calibrator.close()


@pytest.mark.parametrize("done", [False, True])
def test_of_updates_in_one_write_a_kill_leaves_all_or_none(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: bool
) -> None:
    """A snapshot is due with the third of six; those that were written come again, each once."""
    monkeypatch.setattr(durable, "_SNAPSHOT_EVERY", 5)
    state, copy = tmp_path / "state", tmp_path / "copy"
    with DurableCalibrator(state, world.guess) as calibrator:
        for table in world.tables[:3]:
            calibrator.update(table)
        with calibrator.in_one_write():
            found = [calibrator.update(table) for table in world.tables[3:9]]
            if not done:
                shutil.copytree(state, copy)
        if done:
            shutil.copytree(state, copy)
        found += map(calibrator.update, world.tables[9:])
    assert json_lines(found) == world.lines[3:]
    with DurableCalibrator(copy, world.guess) as resumed:
        assert resumed.tracker.frame == (found[5].frame if done else found[0].frame - 1)
        assert json_lines(resumed.repeated[3:]) == (world.lines[3:9] if done else [])


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


def sealed(body: bytes, kind: Kind = "state") -> bytes:
    """With the mark and the checksum of a whole file of this version."""
    mark = encode((), kind).partition(b"\n")[0]
    return mark + b"\n" + sha256(body).digest() + body


def array(dtype: str, shape: list[int], data: bytes) -> msgpack.ExtType:
    return msgpack.ExtType(0, msgpack.packb([dtype, shape, data]))


WRONG = [
    None, True, 5, -1, 2**64 - 1, 1.5, "text", b"bytes", [], {}, {"a": 1}, {5: None}, [1, []],
    [None, None], [[], []], [5, None], ["5", []], [{}, {}], [1, 2, 3], msgpack.Timestamp(5),
    [None, msgpack.Timestamp(5)], {"_frames": []}, {"most": "5"},
    array("<f8", [2**62, 4], b""), array("<f8", [2**40, 2**40], b""), array("<f8", [], bytes(8)),
    array("<f8", [-4, 1], bytes(8)), [array("<f8", [1], bytes(8)), []],
    msgpack.ExtType(1, b""), msgpack.ExtType(1, msgpack.packb("no pose")),
    msgpack.ExtType(2, msgpack.packb({})), msgpack.ExtType(4, msgpack.packb([])),
    msgpack.ExtType(20, msgpack.packb({"cameras": 5})),
]  # fmt: skip


BODIES = [
    *map(msgpack.packb, WRONG),
    b"",
    b"\xc1",
    msgpack.packb([1, 2])[:-1],
    msgpack.packb(msgpack.ExtType(99, b"")),
    msgpack.packb(msgpack.ExtType(0, msgpack.packb(["|O8", [1], bytes(8)]))),
    msgpack.packb(msgpack.ExtType(0, msgpack.packb(["<f8", [2], bytes(8)]))),
    msgpack.packb(msgpack.ExtType(4, msgpack.packb({"unknown": 1}))),
    b"\x91" * 100_000,
]


@pytest.mark.parametrize("body", BODIES, ids=range(len(BODIES)))
def test_content_of_a_wrong_kind_is_refused_though_its_checksum_is_right(
    pair: Rig, tmp_path: Path, body: bytes
) -> None:
    path = tmp_path / "saved"
    path.write_bytes(sealed(body))
    with pytest.raises(FileError, match="is no tracker's state") as error:
        IncrementalCalibrator.load(path)
    assert "\n" not in str(error.value)
    DurableCalibrator(tmp_path / "state", pair).close()
    with closing(StateDatabase(tmp_path / "state")) as database:
        database.append(sealed(body, "input"))
    with pytest.raises(FileError, match=r"of another version.*is no tracker's input") as error:
        DurableCalibrator(tmp_path / "state", pair)
    assert "\n" not in str(error.value)


def test_spoilt_bytes_are_refused_or_taken_though_their_checksum_is_right(
    pair: Rig, tmp_path: Path
) -> None:
    """Cut short, and with other bytes, as no disk makes them: what reads them has to notice."""
    tracker = IncrementalCalibrator(pair)
    for table in drive_at(lambda _: pair, 6):
        tracker.update(table)
    body = tracker.to_bytes().partition(b"\n")[2][32:]
    rng, refused = np.random.default_rng(0), 0
    for _ in range(100):
        spoilt = bytearray(body)
        for place in rng.integers(0, len(body), rng.choice([1, 3, 30])):
            spoilt[place] = rng.integers(256)
        path = tmp_path / "saved"
        path.write_bytes(sealed(bytes(spoilt[: rng.choice([len(body), place])])))
        try:
            IncrementalCalibrator.load(path)
        except FileError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 30
