"""A saved tracker: the same numbers after loading, and files that are refused."""

from __future__ import annotations

import io
import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import (
    FileError,
    IncrementalCalibrator,
    Rig,
)
from calibgraph.tracking.state_bytes import StateError, decode, encode
from tests.tracking.steps import drive, moved, step_of, tracked

Array = np.ndarray


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
    assert data[:head] == b"calibgraph-tracker-file/1\n"
    for wrong, match in (
        (data[:-1], "is damaged: its checksum is wrong"),
        (data[:-9] + bytes(9), "is damaged: its checksum is wrong"),
        (data[:head], "is damaged: its checksum is wrong"),
        (b"", "is not a calibgraph-tracker-file/1 file"),
        (b"calibgraph-tracker-file/2\n" + data[head:], "is not a calibgraph-tracker-file/1 file"),
        (b"calibgraph-tracker/1\n" + data[head:], "is not a calibgraph-tracker-file/1 file"),
        (b"SQLite format 3\0" + bytes(100), "is not a calibgraph-tracker-file/1 file"),
    ):
        path.write_bytes(wrong)
        with pytest.raises(FileError, match=match) as error:
            IncrementalCalibrator.load(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)
        assert path.read_bytes() == wrong


def archive(**members: Any) -> bytes:
    out = io.BytesIO()
    np.savez(out, **members)
    return out.getvalue()


def text(content: object) -> Array:
    return np.frombuffer(json.dumps(content).encode(), np.uint8)


def compressed() -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, json=np.zeros(10**6, np.uint8))
    return out.getvalue()


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "is not a tracker's state"),
        (b"other", "is not a tracker's state"),
        (archive(json=np.array([object()])), "is not a tracker's state .*pickle"),
        (archive(json=text({"format": "calibgraph-tracker-state/8"})), "is of format .*state/8"),
        (
            archive(json=text({"format": "calibgraph-tracker-state/6"})),
            "is of format .*state/6', expected .*state/7",
        ),
        (archive(json=text([])), "is not a tracker's state"),
        (archive(other=text([])), "is not a tracker's state"),
        (compressed(), "it is compressed"),
    ],
)
def test_bytes_that_are_no_state_are_refused(data: bytes, match: str) -> None:
    with pytest.raises(StateError, match=match) as error:
        decode(data)
    assert "\n" not in str(error.value)


def test_a_class_that_is_not_listed_is_neither_written_nor_read(pair: Rig) -> None:
    class State:
        """Has the name of one that is listed."""

    with pytest.raises(TypeError, match="cannot write a State"):
        encode(State(), pair)
    good = encode(None, pair)
    with np.load(io.BytesIO(good)) as members:
        described = json.loads(members["json"].tobytes())
        arrays = {name: members[name] for name in members if name != "json"}
    for tree in ({"dataclass": "Path", "fields": {}}, {"call": "os.system"}, {"lens": 99}):
        with pytest.raises(StateError, match="is not a tracker's state"):
            decode(archive(json=text({**described, "tree": tree}), **arrays))


def test_a_state_changed_at_any_place_raises_nothing_else(pair: Rig) -> None:
    """Not even when the checksum of its file is right."""
    tracker, _ = tracked(pair, drive(lambda frame: pair, 3))
    data = tracker.to_bytes()
    rng = np.random.default_rng(0)
    for at in rng.choice(len(data), 200).tolist():
        changed = bytearray(data)
        changed[at] ^= 0xFF
        with suppress(StateError):
            decode(bytes(changed))
