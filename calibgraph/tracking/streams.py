"""Frames of correspondences, one at a time: of a table, or JSON lines on standard input.

A line of JSON holds a frame::

    {"frame": 7, "cameras": {"left": {"u_px": [...], "v_px": [...],
                                      "x_m": [...], "y_m": [...], "z_m": [...]}}}

Optional in a camera: ``confidence``; ``i_uu_px``, ``i_uv_px`` and ``i_vv_px``; ``point_index``.
Optional beside ``frame``: ``stamp_ns``; ``place``, where the vehicle is, a name or a number;
``twist_per_s``, the six columns ``wx_rad_s`` to ``vz_m_s`` of a table; and ``metadata``, as there.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import from_json

from calibgraph.errors import CalibrationError, CorrespondenceError, FileError, MotionError
from calibgraph.files import decode_text, describe
from calibgraph.io.bags.storage import is_bag
from calibgraph.io.tables import load_correspondences
from calibgraph.model.correspondences import (
    COORDINATES,
    INFORMATION,
    Correspondences,
    as_confidence,
)
from calibgraph.tracking.frame_order import LONGEST_PLACE, StreamFrame

Item = StreamFrame | CalibrationError
"""A frame, or why there is none."""

MAX_CAMERAS = 1000
MAX_LINE_BYTES = 64 * 2**20
_DATASET = "to track a dataset, say what matches its frames: --matcher structure"

Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]


def frames_of(source: Path | str) -> Iterator[Item]:
    """The frames of a table, or of "-": JSON lines on standard input.

    Raises:
        FileError: at once, if there is no such source or a row of the table is wrong; while it is
            read, if standard input is not text.
    """
    if str(source) == "-":
        if sys.stdin is None:
            raise FileError("standard input", "is closed; pipe frames in")
        return frames_of_lines(sys.stdin.buffer, "standard input")
    path = Path(source)
    if os.path.isdir(path) or (os.path.exists(path) and is_bag(path)):
        raise FileError(path, f"is no table of correspondences; {_DATASET}")
    return frames_of_table(load_correspondences(path))


def frames_of_table(table: Correspondences) -> Iterator[StreamFrame]:
    """The frames of a table, in ascending order."""
    order = np.argsort(table.frame, kind="stable")
    numbers, starts = np.unique(table.frame[order], return_index=True)
    for number, rows in zip(numbers.tolist(), np.split(order, starts[1:]), strict=True):
        yield StreamFrame(number, table.select(rows))


class CameraColumns(BaseModel):
    """One camera's correspondences as lists of one length; see the table of correspondences."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    u_px: list[float]
    v_px: list[float]
    x_m: list[float]
    y_m: list[float]
    z_m: list[float]
    confidence: list[float] = []
    i_uu_px: list[float] = []
    i_uv_px: list[float] = []
    i_vv_px: list[float] = []
    point_index: list[Int64] = []

    @model_validator(mode="after")
    def _require_whole_table(self) -> Self:
        given = self.model_fields_set
        partial = sorted(given.intersection(INFORMATION))
        if partial and len(partial) < len(INFORMATION):
            raise ValueError(f"has only {partial} of {list(INFORMATION)}; add all")
        lengths = {k: len(getattr(self, k)) for k in type(self).model_fields if k in given}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the lists differ in length: {lengths}")
        return self


class FrameLine(BaseModel):
    """One line: the correspondences of one frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    frame: Int64
    stamp_ns: Int64 | None = None
    cameras: Annotated[dict[str, CameraColumns], Field(max_length=MAX_CAMERAS)]
    place: Annotated[str, Field(max_length=LONGEST_PLACE)] | Int64 | None = None
    twist_per_s: Annotated[list[float], Field(min_length=6, max_length=6)] | None = None
    metadata: dict[str, Any] = {}

    def to_frame(self) -> StreamFrame:
        """The frame with the correspondences of all its cameras.

        Raises:
            CorrespondenceError: if a value is out of its range.
        """
        cameras = [*self.cameras.values()]
        counts = [len(camera.u_px) for camera in cameras]
        n = sum(counts)
        information = self._columns(INFORMATION, (1, 0, 1))
        indices = self._columns(("point_index",), (-1,), np.int64)
        confidence = self._columns(("confidence",), (1,))
        coordinates = self._columns(COORDINATES, [np.nan] * len(COORDINATES))
        none = np.zeros((0, 5))
        coordinates = none if coordinates is None else coordinates
        table = Correspondences(
            cameras=tuple(self.cameras),
            camera_index=np.repeat(np.arange(len(cameras), dtype=np.int32), counts),
            frame=np.full(n, self.frame, np.int64),
            pixels_px=coordinates[:, :2].copy(),
            points_lidar_m=coordinates[:, 2:].copy(),
            confidence=as_confidence(np.ones(n) if confidence is None else confidence[:, 0]),
            information_px=information,
            stamp_ns=None if self.stamp_ns is None else np.full(n, self.stamp_ns),
            point_index=None if indices is None else indices[:, 0],
            twist_per_s=np.tile(self.twist_per_s, (n, 1)) if self.twist_per_s and n else None,
            metadata=self.metadata,
        )
        return StreamFrame(self.frame, table, self.stamp_ns, self.place)

    def _columns(self, keys: Sequence[str], missing: Sequence[float], kind: type = float) -> Any:
        """(n, k) columns; with a value for cameras that do not give them, None if none does."""
        cameras = self.cameras.values()
        if not any(getattr(camera, keys[0]) for camera in cameras):
            return None
        rows = [
            [v for one in cameras for v in getattr(one, key) or [default] * len(one.u_px)]
            for key, default in zip(keys, missing, strict=True)
        ]
        return np.array(rows, kind).T.copy()


def frames_of_lines(file: BinaryIO, where: str) -> Iterator[Item]:
    """The frames of JSON lines, each as soon as its line is complete; none is read ahead.

    Args:
        file: the lines.
        where: its name in messages.

    Raises:
        FileError: if it is not text, a line is too long or it cannot be read.
        MotionError: if a motion is that of no vehicle: slower frames would be wrong unseen.
    """
    number = 0
    while line := _read_line(file, where):
        number += 1
        place = f"{where}, line {number}"
        if len(line) > MAX_LINE_BYTES:
            raise FileError(place, f"is longer than {MAX_LINE_BYTES} bytes; send a frame a line")
        if number == 1 and "\0" in decode_text(line, where):
            raise FileError(where, "is not text; send a line of JSON per frame, in UTF-8")
        if line.strip():
            yield _parse(line.removeprefix(b"\xef\xbb\xbf"), place)


def _read_line(file: BinaryIO, where: str) -> bytes:
    try:
        return file.readline(MAX_LINE_BYTES + 1)
    except (OSError, ValueError) as error:
        raise FileError(where, f"cannot be read ({error}); restart") from error


def _parse(line: bytes, where: str) -> Item:
    try:
        return FrameLine.model_validate(from_json(line, allow_inf_nan=False)).to_frame()
    except ValidationError as error:
        return FileError(where, describe(error))
    except MotionError as error:
        raise MotionError(f"{where}: {error.without_row}; correct that of all frames") from error
    except CorrespondenceError as error:
        return FileError(where, error.without_row)
    except ValueError as error:
        return FileError(where, f"is not JSON ({error}); send one frame a line, as JSON")
