"""What a tracker keeps: the same numbers after loading, and files that are refused."""

from __future__ import annotations

from contextlib import closing
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
from calibgraph.tracking.state_bytes import Kind, StateError, decode, encode
from calibgraph.tracking.state_database import StateDatabase
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
