"""Sources of frames: tables, JSON lines, pipes; what is refused."""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pytest

from calibgraph import Correspondences, FileError
from calibgraph.tracking import frames
from calibgraph.tracking.frames import Item, StreamFrame, frames_of, frames_of_lines

to_arrow = Correspondences.to_arrow

COORDINATES = ("u_px", "v_px", "x_m", "y_m", "z_m")


def table(frames: list[int], *, camera: str = "left", **changes: Any) -> Correspondences:
    """One row per given frame number; its pixel's column is the number of its row."""
    n = len(frames)
    columns: dict[str, Any] = {
        "camera": camera,
        "frame": np.array(frames, np.int64),
        "pixels_px": np.column_stack([np.arange(n), np.zeros(n)]),
        "points_lidar_m": np.tile([10.0, 0.0, 0.0], (n, 1)),
    }
    return Correspondences.from_arrays(**(columns | changes))


def camera(n: int = 1, **changes: Any) -> dict[str, Any]:
    return {key: [1.5] * n for key in COORDINATES} | changes


def line(frame: Any = 7, **changes: Any) -> bytes:
    """A line of JSON with one camera, or with other keys."""
    return json.dumps({"frame": frame, "cameras": {"left": camera()}} | changes).encode() + b"\n"


def of_bytes(data: bytes) -> list[Item]:
    return [*frames_of_lines(io.BytesIO(data), "standard input")]


def outcomes(items: Any) -> list[int | str]:
    """Frame numbers, and the messages in between."""
    return [item.frame if isinstance(item, StreamFrame) else str(item) for item in items]


def refusal(data: bytes) -> str:
    """The message of the first of two lines; the second, good one must come through."""
    message, frame = outcomes(of_bytes(data.rstrip(b"\n") + b"\n" + line(8)))
    assert frame == 8
    assert isinstance(message, str)
    assert message.startswith("standard input, line 1: ")
    assert "\n" not in message
    assert not re.search(r"\brows?\b", message)  # of a table, which nobody has here
    return message


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_table_gives_its_frames_in_ascending_order(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"table{suffix}"
    stamps = {"stamp_ns": [30, 10, 20, 31]}
    table([3, 1, 2, 3], camera="left", metadata={"matcher": "m"}, **stamps).save(path)
    frames = list(frames_of(path))
    assert outcomes(frames) == [1, 2, 3]
    last = frames[-1]
    assert isinstance(last, StreamFrame)
    assert last.table.pixels_px[:, 0].tolist() == [0, 3]
    assert last.table.frame.tolist() == [3, 3]
    assert last.table.stamp_ns is not None and last.table.stamp_ns.tolist() == [30, 31]
    if suffix == ".parquet":
        assert last.table.metadata == {"matcher": "m"}


# JSON lines


def test_a_json_line_is_a_frame() -> None:
    left = camera(2, confidence=[0.5, 1], u_px=[1, 2])
    right = camera(1, i_uu_px=[2], i_uv_px=[0.5], i_vv_px=[1], late_s=[0.03])
    (item,) = of_bytes(
        line(cameras={"right": right, "left": left}, stamp_ns=2**62, metadata={"matcher": "m"})
    )
    assert isinstance(item, StreamFrame)
    assert (item.frame, item.table.metadata) == (7, {"matcher": "m"})
    assert item.table.stamp_ns is not None and set(item.table.stamp_ns) == {2**62}
    assert item.table.counts() == {"left": 2, "right": 1}
    left_rows, right_rows = item.table.of_camera("left"), item.table.of_camera("right")
    assert left_rows.pixels_px.tolist() == [[1, 1.5], [2, 1.5]]
    assert left_rows.confidence.tolist() == [0.5, 1]
    assert left_rows.information_px.tolist() == [[1, 0, 1]] * 2
    assert right_rows.information_px.tolist() == [[2, 0.5, 1]]
    assert right_rows.confidence.tolist() == [1]
    assert (left_rows.late_s.tolist(), right_rows.late_s.tolist()) == ([0, 0], [0.03])


@pytest.mark.parametrize("cameras", [{}, {"left": camera(0)}])
def test_a_frame_without_rows_is_a_frame(cameras: dict[str, Any]) -> None:
    (item,) = of_bytes(line(9, cameras=cameras, stamp_ns=5, metadata={"k": 1}))
    assert isinstance(item, StreamFrame)
    assert (item.frame, len(item.table)) == (9, 0)
    assert item.table.cameras == tuple(cameras)
    assert item.table.metadata == {"k": 1}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (line()[:-9], "is not JSON"),
        (b"[" * 100_000, "is not JSON (recursion limit exceeded"),
        (b"[1]", "expected keys with values, as in {key: value}, found [1]"),
        (b'{"frame": ' + b"9" * 5000 + b', "cameras": {}}', "is not JSON (number out of range"),
        (b'{"frame": 7}', "key 'cameras' is missing"),
        (line(weather="rain"), "unknown key 'weather'; remove it"),
        (line(1.0), "frame: Input should be a valid integer, found 1.0"),
        (line(2**63), "frame: Input should be less than 9223372036854775808, found"),
        (line(cameras={"left": camera(depth=[1])}), "unknown key 'cameras.left.depth'"),
        (line(cameras={"left": camera(u_px=[True])}), "u_px.0: Input should be a valid number"),
        (line(cameras={"left": camera(u_px=[10**400])}), "u_px.0: Input should be a valid number"),
        (line().replace(b"[1.5]", b"[1e999]"), "camera 'left': pixel must be finite"),
        (line(cameras={"left": camera(u_px=[1, 2])}), "differ in length: {'u_px': 2, 'v_px': 1"),
        (line(cameras={"left": camera(i_uu_px=[1])}), "has only ['i_uu_px'] of"),
    ],
)
def test_a_wrong_line_is_refused_and_the_next_one_read(wrong: bytes, message: str) -> None:
    assert message in refusal(wrong)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (line()[:-1].ljust(100_001), "line 1: is longer than 100000 bytes"),
        (line() + b'{"frame": "' + b"x" * 1_000_000, "line 2: is longer than 100000 bytes"),
        (b"PAR1\x15\x04\0\0", "is not text; send a line of JSON per frame"),
        (b"\x89PNG\n", "is not UTF-8"),
        (line().decode().encode("utf-16"), "is not a text file in UTF-8"),
    ],
)
def test_what_is_no_text_in_lines_ends_the_stream(
    data: bytes, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frames, "MAX_LINE_BYTES", 100_000)
    with pytest.raises(FileError, match=f"standard input.*{message}"):
        of_bytes(data)
    assert outcomes(of_bytes(line()[:-1].ljust(100_000))) == [7]  # it just fits


def test_json_lines_cut_or_damaged_anywhere_raise_nothing() -> None:
    data = line(1) + line(2)
    for cut in range(len(data)):
        items = outcomes(of_bytes(data[:cut]))
        assert items[: cut // len(line(1))] == [1][: cut // len(line(1))]
        assert len(items) <= 2


@pytest.fixture
def pipe() -> Iterator[tuple[BinaryIO, BinaryIO]]:
    """The reading and the writing end of a pipe."""
    reading, writing = os.pipe()
    with os.fdopen(reading, "rb") as reader, os.fdopen(writing, "wb", buffering=0) as writer:
        yield reader, writer


def test_a_complete_line_is_given_while_the_next_is_being_written(
    pipe: tuple[BinaryIO, BinaryIO],
) -> None:
    reader, writer = pipe
    frames = frames_of_lines(reader, "standard input")
    for number in range(3):
        writer.write(line(number) + b'{"fra')
        assert outcomes([next(frames)]) == [number]
        writer.write(b"me\n")
        assert "is not JSON" in str(outcomes([next(frames)])[0])


def test_a_source_that_is_none_is_refused_at_once(tmp_path: Path) -> None:
    table([3]).save(tmp_path / "a.parquet")
    os.mkfifo(tmp_path / "pipe")
    calls: dict[str, Callable[[], object]] = {
        "missing.parquet: no such file": lambda: frames_of(tmp_path / "missing.parquet"),
        "cannot be read": lambda: frames_of("x" * 300),
        "is no file that can be read": lambda: frames_of(tmp_path / "pipe"),
        "is no table of correspondences; match its frames": lambda: frames_of(tmp_path),
    }
    for message, call in calls.items():
        with pytest.raises(FileError, match=message):
            call()
