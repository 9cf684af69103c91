"""Frames of JSON lines."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from calibgraph.tracking import stream_lines
from calibgraph.tracking.streams import StreamFrame
from tests.tracking.stream_data import (
    camera,
    line,
    of_bytes,
    outcomes,
    refusal,
)

# JSON lines


def test_a_json_line_is_a_frame() -> None:
    left = camera(2, confidence=[0.5, 1], point_index=[3, -1], u_px=[1, 2])
    right = camera(1, i_uu_px=[2], i_uv_px=[0.5], i_vv_px=[1])
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
    assert left_rows.point_index is not None
    assert left_rows.point_index.tolist() == [3, -1]
    assert left_rows.information_px is not None
    assert left_rows.information_px.tolist() == [[1, 0, 1]] * 2
    assert right_rows.information_px is not None
    assert right_rows.information_px.tolist() == [[2, 0.5, 1]]
    assert right_rows.point_index is not None
    assert right_rows.point_index.tolist() == [-1]
    assert right_rows.confidence.tolist() == [1]


def test_a_line_of_metadata_alone_holds_for_the_frames_after_it() -> None:
    header = {"metadata": {"systematic_rotation_rad": 0.001, "matcher": "mine"}}
    lines = [line(1), json.dumps(header).encode(), line(2), line(3, metadata={"matcher": "other"})]
    first, second, third = of_bytes(b"\n".join(each.strip() for each in lines))
    assert [type(item) for item in (first, second, third)] == [StreamFrame] * 3
    assert not first.table.findings.states_common_error
    assert second.table.metadata == {"systematic_rotation_rad": 0.001, "matcher": "mine"}
    assert third.table.metadata == {"systematic_rotation_rad": 0.001, "matcher": "other"}


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
        (b"\xfe\xfe", "is not JSON"),
        (b"[" * 100_000, "is not JSON (recursion limit exceeded"),
        (b"[1]", "expected keys with values, as in {key: value}, found [1]"),
        (b'{"frame": ' + b"9" * 5000 + b', "cameras": {}}', "is not JSON (number out of range"),
        (b'{"frame": 7}', "key 'cameras' is missing"),
        (line(weather="rain"), "unknown key 'weather'; remove it"),
        (line(1.0), "frame: Input should be a valid integer, found 1.0"),
        (line(2**63), "frame: Input should be less than 9223372036854775808, found"),
        (line(cameras={"left": {}}), "key 'cameras.left.u_px' is missing"),
        (line(cameras={"left": camera(depth=[1])}), "unknown key 'cameras.left.depth'"),
        (
            line(cameras={"left": camera(u_px=[True])}),
            "u_px.0: Input should be a valid number, found True",
        ),
        (
            line(cameras={"left": camera(u_px=[10**400])}),
            "u_px.0: Input should be a valid number, found 1000",
        ),
        (line(cameras={"left": camera(u_px=[float("nan")])}), "is not JSON"),
        (line().replace(b"[1.5]", b"[1e999]"), "pixel must be finite"),
        (line(cameras={"left": camera(u_px=[1, 2])}), "differ in length: {'u_px': 2, 'v_px': 1"),
        (line(cameras={"left": camera(confidence=[2])}), "confidence must lie in (0, 1]"),
        (
            line(cameras={"left": camera(point_index=[0.5])}),
            "point_index.0: Input should be a valid integer, found 0.5",
        ),
        (
            line(cameras={"left": camera(point_index=[2**63])}),
            "point_index.0: Input should be less than 9223372036854775808",
        ),
        (line(cameras={"left": camera(i_uu_px=[1])}), "has only ['i_uu_px'] of"),
        (
            line(cameras={str(i): camera(0) for i in range(1001)}),
            "cameras: Dictionary should have at most 1000 items",
        ),
        (
            line(metadata={"systematic_rotation_rad": "x"}),
            "systematic_rotation_rad: expected a number from 0 to 3.14, found 'x'; correct it, or",
        ),
    ],
)
def test_a_wrong_line_is_refused_and_the_next_one_read(wrong: bytes, message: str) -> None:
    assert message in refusal(wrong)


def test_a_line_that_is_too_long_is_refused_without_being_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stream_lines, "MAX_LINE_BYTES", 100_000)
    long = b'{"frame": "' + b"x" * 1_000_000 + b'"}'
    assert "is longer than 100000 bytes" in refusal(long)
    # Neither does one byte too many pass, nor is one that just fits refused.
    fits = line()[:-1].ljust(100_000)
    assert outcomes(of_bytes(fits)) == [7]
    assert "is longer than" in refusal(fits + b" ")
    assert len(outcomes(of_bytes(long))) == 1


def test_json_lines_cut_or_damaged_anywhere_raise_nothing() -> None:
    data = line(1) + line(2)
    for cut in range(len(data)):
        items = outcomes(of_bytes(data[:cut]))
        assert items[: cut // len(line(1))] == [1][: cut // len(line(1))]
        assert len(items) <= 2
    rng = np.random.default_rng(0)
    for _ in range(500):
        flipped = np.frombuffer(data, np.uint8).copy()
        flipped[rng.integers(0, len(data), rng.integers(1, 4))] = rng.integers(256)
        for item in of_bytes(flipped.tobytes()):
            assert isinstance(item, StreamFrame) or "\n" not in item.message
