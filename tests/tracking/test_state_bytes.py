"""A saved tracker: the same numbers after loading, and files that are refused."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import msgpack
import numpy as np
import pytest

from calibgraph import (
    FileError,
    IncrementalCalibrator,
    Rig,
)
from calibgraph.tracking.state_bytes import FORMAT, StateError, decode, encode
from tests.tracking.steps import drive, moved, step_of


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
    assert data[:head].decode() == f"{FORMAT}\n"
    for wrong, match in (
        (data[:-1], "is damaged: its checksum is wrong"),
        (data[:-9] + bytes(9), "is damaged: its checksum is wrong"),
        (data[:head], "is damaged: its checksum is wrong"),
        (b"", "begins with '', expected 'calibgraph-tracker-state/8'"),
        (b"calibgraph-tracker-state/9\n" + data[head:], "begins with 'calibgraph-tracker-state/9'"),
        (b"calibgraph-tracker-file/1\n" + data[head:], "begins with 'calibgraph-tracker-file/1'"),
        (b"SQLite format 3\0" + bytes(100), "begins with 'SQLite format 3"),
    ):
        path.write_bytes(wrong)
        with pytest.raises(FileError, match=match) as error:
            IncrementalCalibrator.load(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
        assert path.read_bytes() == wrong


def sealed(body: bytes) -> bytes:
    """With the checksum of a whole file."""
    return f"{FORMAT}\n".encode() + sha256(body).digest() + body


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
        decode(sealed(body))
    assert "\n" not in str(error.value)


def test_a_class_that_is_not_listed_is_not_written() -> None:
    class State:
        """Has the name of one that is listed."""

    for value in (State(), {"a": [object()]}, np.array([object()]), np.float32(1), 2**64):
        with pytest.raises(TypeError, match="cannot write a"):
            encode(value)
    deep: list[object] = []
    for _ in range(2000):
        deep = [deep]
    with pytest.raises(ValueError, match="recursion"):
        encode(deep)
