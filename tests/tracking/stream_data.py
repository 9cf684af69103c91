"""Tables and JSON lines for the tests of streams."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pyarrow as pa

from calibgraph import Correspondences
from calibgraph.tracking.streams import Refused, StreamFrame, frames_of

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


def spoilt(given: pa.Table, column: str, row: int, value: object) -> pa.Table:
    """An Arrow table with one value replaced."""
    index = given.column_names.index(column)
    values = given[column].to_pylist()
    values[row] = value
    return given.set_column(index, column, pa.array(values))


def camera(n: int = 1, **changes: Any) -> dict[str, Any]:
    return {key: [1.5] * n for key in COORDINATES} | changes


def line(frame: Any = 7, **changes: Any) -> bytes:
    """A line of JSON with one camera, or with other keys."""
    return json.dumps({"frame": frame, "cameras": {"left": camera()}} | changes).encode() + b"\n"


def of_bytes(data: bytes) -> list[StreamFrame | Refused]:
    return list(frames_of("-", stdin=io.BytesIO(data)))


def outcomes(items: Any) -> list[int | str]:
    """Frame numbers, and the messages in between."""
    return [item.frame if isinstance(item, StreamFrame) else item.message for item in items]


def refusal(data: bytes) -> str:
    """The message of the first of two lines; the second, good one must come through."""
    message, frame = outcomes(of_bytes(data.rstrip(b"\n") + b"\n" + line(8)))
    assert frame == 8
    assert isinstance(message, str)
    assert message.startswith("standard input, line 1: ")
    assert "\n" not in message
    return message
