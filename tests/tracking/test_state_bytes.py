"""What a tracker keeps: the same numbers after loading, and files that are refused."""

from __future__ import annotations

from contextlib import closing
from dataclasses import fields, replace
from hashlib import sha256
from pathlib import Path

import msgpack
import numpy as np
import pytest

from calibgraph import (
    DurableCalibrator,
    FileError,
    IncrementalCalibrator,
    Rig,
)
from calibgraph.tracking.history import History
from calibgraph.tracking.state import State
from calibgraph.tracking.state_bytes import Kind, StateError, decode, encode
from calibgraph.tracking.state_database import StateDatabase
from tests.tracking.steps import drive, moved, step_of, tracked

KINDS: tuple[Kind, ...] = ("state", "input", "history")


def test_a_saved_tracker_continues_with_the_same_numbers(pair: Rig, tmp_path: Path) -> None:
    """Saved while starting, between epochs, within one, with outlier frames, after a step.

    An epoch has 10 frames: each goes on to the end of the one after it.
    """
    after = moved(pair, "left", step_of(0.5, 3))
    tables = drive(lambda frame: after if frame >= 42 else pair, 56, failed_share=0.1)
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


def test_a_file_that_is_no_saved_tracker_is_refused_in_one_line(pair: Rig, tmp_path: Path) -> None:
    path = tmp_path / "saved"
    IncrementalCalibrator(pair).save(path)
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    assert data[:head] == b"calibgraph-tracker-state/11\n"
    for wrong, match in (
        (data[:-1], "is damaged: its checksum is wrong"),
        (data[:-9] + bytes(9), "is damaged: its checksum is wrong"),
        (data[:head], "is damaged: its checksum is wrong"),
        (b"", "begins with '', expected 'calibgraph-tracker-state/11'"),
        (
            b"calibgraph-tracker-state/12\n" + data[head:],
            "begins with 'calibgraph-tracker-state/12'",
        ),
        (b"calibgraph-tracker-file/1\n" + data[head:], "begins with 'calibgraph-tracker-file/1'"),
        (b"x\x9c\xed\x00" + bytes(100), "begins with 'x', expected"),
        (b"SQLite format 3\0" + bytes(100), "begins with 'SQLite format 3"),
    ):
        path.write_bytes(wrong)
        with pytest.raises(FileError, match=match) as error:
            IncrementalCalibrator.load(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
        assert path.read_bytes() == wrong


def sealed(body: bytes, kind: Kind = "state") -> bytes:
    """With the mark and the checksum of a whole file of this version."""
    mark = encode({}, "history").partition(b"\n")[0].replace(b"history", kind.encode())
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


@pytest.mark.parametrize("wrong", WRONG, ids=repr)
def test_content_of_a_wrong_kind_is_refused_though_its_checksum_is_right(
    pair: Rig, tmp_path: Path, wrong: object
) -> None:
    body = msgpack.packb(wrong)
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


def test_state_input_and_history_are_not_taken_for_each_other(pair: Rig) -> None:
    tracker, _ = tracked(pair, tables := drive(lambda frame: pair, 2))
    for kind in KINDS:
        data = sealed(b"", kind)
        for other in {*KINDS} - {kind}:
            with pytest.raises(StateError, match=f"no tracker's {other}: it begins .*-{kind}/"):
                decode(data, other)
    for content, kind in (
        (decode(tracker.to_bytes(), "state"), "input"),
        ((1, tables[0]), "state"),
    ):
        with pytest.raises(StateError, match=f"is no tracker's {kind} "):
            decode(encode(content, kind), kind)


def test_a_state_with_a_part_of_a_wrong_kind_raises_nothing_else(pair: Rig, tmp_path: Path) -> None:
    tracker, _ = tracked(pair, drive(lambda frame: pair, 3))
    state, since = decode(tracker.to_bytes(), "state")
    path, refused = tmp_path / "saved", 0
    for one in fields(State):
        for wrong in (None, "text", (), np.zeros((0, 3))):
            changed = replace(state, **{one.name: wrong})
            path.write_bytes(encode((changed, since), "state"))
            try:
                IncrementalCalibrator.load(path)
            except FileError as error:
                refused += 1
                assert "\n" not in str(error)
    assert refused > 2 * len(fields(State))


def test_a_history_survives_a_file_and_a_damaged_file_gives_an_empty_one(
    pair: Rig, tmp_path: Path
) -> None:
    _, updates = tracked(pair, drive(lambda frame: pair, 5))
    history, path = History(), tmp_path / "history.state"
    for update in updates:
        history.add(update)
    history.save(path)
    loaded = History.load(path)
    assert len(loaded) == 5 and loaded.events == history.events != ()
    whole = path.read_bytes()
    parts = decode(whole, "history")
    other = ({}, {**parts, "frames": None}, {**parts, "most": "2"}, {**parts, "most": 1})
    for wrong in (
        whole[:-1],
        b"",
        whole.replace(b"left", b"lift"),
        sealed(b"", "state"),
        *(encode(content, "history") for content in other),
    ):
        path.write_bytes(wrong)
        assert len(History.load(path)) == 0


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"\xc1",
        msgpack.packb([1, 2])[:-1],
        msgpack.packb(msgpack.ExtType(99, b"")),
        msgpack.packb(msgpack.ExtType(0, msgpack.packb(["|O8", [1], bytes(8)]))),
        msgpack.packb(msgpack.ExtType(0, msgpack.packb(["<f8", [2], bytes(8)]))),
        msgpack.packb(msgpack.ExtType(4, msgpack.packb({"unknown": 1}))),
        b"\x91" * 100_000,
    ],
)
def test_bytes_that_are_no_state_are_refused(body: bytes) -> None:
    with pytest.raises(StateError, match="is no tracker's state") as error:
        decode(sealed(body), "state")
    assert "\n" not in str(error.value)


def test_a_class_that_is_not_listed_is_not_written() -> None:
    class State:
        """Has the name of one that is listed."""

    for value in (State(), {"a": [object()]}, np.array([object()]), np.float32(1), 2**64):
        with pytest.raises(TypeError, match="cannot write a"):
            encode(value, "state")
    deep: list[object] = []
    for _ in range(2000):
        deep = [deep]
    with pytest.raises(ValueError, match="recursion"):
        encode(deep, "state")
