"""Frames of correspondences from JSON lines.

A line holds a frame::

    {"frame": 7, "cameras": {"left": {"u_px": [...], "v_px": [...],
                                      "x_m": [...], "y_m": [...], "z_m": [...]}}}

Optional in a camera: ``confidence``; ``i_uu_px``, ``i_uv_px`` and ``i_vv_px``; ``point_index``.
Optional beside ``frame``: ``stamp_ns``; ``place``, where the vehicle is, a name or a number;
``twist_per_s``, the six columns ``wx_rad_s`` to ``vz_m_s`` of a table; and ``metadata``, as there.
A line with ``metadata`` alone is a header, and holds for the lines after it, as here for the error
that all frames share::

    {"metadata": {"systematic_rotation_rad": 0.001, "systematic_translation_m": 0.01}}
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import from_json

from calibgraph.errors import CorrespondenceError, MotionError
from calibgraph.files import describe
from calibgraph.model.correspondences import (
    COORDINATES,
    INFORMATION,
    Correspondences,
    as_confidence,
)
from calibgraph.model.findings import MatcherFindings
from calibgraph.tracking.frame_order import LONGEST_PLACE, with_place
from calibgraph.tracking.stream_tables import Item, StreamFrame, refused

MAX_CAMERAS = 1000
MAX_LINE_BYTES = 64 * 2**20


Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Twist = Annotated[list[float], Field(min_length=6, max_length=6)]
PlaceName = Annotated[str, Field(max_length=LONGEST_PLACE)] | Int64


class CameraColumns(BaseModel):
    """One camera's correspondences as lists of one length; see the table of correspondences."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    u_px: list[float]
    v_px: list[float]
    x_m: list[float]
    y_m: list[float]
    z_m: list[float]
    confidence: list[float] = Field(default_factory=list)
    i_uu_px: list[float] = Field(default_factory=list)
    i_uv_px: list[float] = Field(default_factory=list)
    i_vv_px: list[float] = Field(default_factory=list)
    point_index: list[Int64] = Field(default_factory=list)

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

    def column(self, key: str, missing: float) -> list[float]:
        """A column; of one value, where it is not given."""
        given: list[float] = getattr(self, key)
        return given if key in self.model_fields_set else [missing] * len(self.u_px)


class HeaderLine(BaseModel):
    """A line that holds for those after it."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    metadata: dict[str, Any]


class FrameLine(BaseModel):
    """One line: the correspondences of one frame."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    frame: Int64
    stamp_ns: Int64 = 0
    cameras: Annotated[dict[str, CameraColumns], Field(max_length=MAX_CAMERAS)]
    place: PlaceName | None = None
    twist_per_s: Twist | None = None
    metadata: dict[str, Any] = Field(default_factory=dict)

    def to_frame(self, header: Mapping[str, Any]) -> StreamFrame:
        """The frame with the correspondences of all its cameras.

        Args:
            header: metadata of all frames, which its own replaces key by key.

        Raises:
            CorrespondenceError: if a value is out of its range.
        """
        counts = [len(camera.u_px) for camera in self.cameras.values()]
        n, names, twist = sum(counts), tuple(sorted(self.cameras)), self.twist_per_s
        stamped = n > 0 and "stamp_ns" in self.model_fields_set
        coordinates = self._columns(COORDINATES, [np.nan] * len(COORDINATES))
        sure, indexed = not self._has("confidence"), n > 0 and self._has("point_index")
        table = Correspondences(
            cameras=names,
            camera_index=np.repeat(np.array([*map(names.index, self.cameras)], np.int32), counts),
            frame=np.full(n, self.frame, np.int64),
            pixels_px=coordinates[:, :2].copy(),
            points_lidar_m=coordinates[:, 2:].copy(),
            confidence=as_confidence(
                np.ones(n) if sure else self._columns(["confidence"], [1])[:, 0]
            ),
            information_px=self._columns(INFORMATION, [1, 0, 1])
            if self._has(INFORMATION[0])
            else None,
            stamp_ns=np.full(n, self.stamp_ns, np.int64) if stamped else None,
            point_index=self._columns(["point_index"], [-1], np.int64)[:, 0] if indexed else None,
            twist_per_s=np.tile(twist, (n, 1)) if n and twist is not None else None,
            metadata={**header, **self.metadata},
        )
        return StreamFrame(self.frame, with_place(table, self.place))

    def _has(self, key: str) -> bool:
        """Whether a camera gives a column."""
        return any(key in camera.model_fields_set for camera in self.cameras.values())

    def _columns(self, keys: Sequence[str], missing: Sequence[float], kind: type = float) -> Any:
        """(n, k) columns of all cameras, with a value of each for those that do not give it."""
        cameras, every = self.cameras.values(), zip(keys, missing, strict=True)
        rows = [[*chain(*(camera.column(*column) for camera in cameras))] for column in every]
        return np.array(rows, kind).T.copy()


def frames_of_lines(chunks: Iterable[bytes], where: str) -> Iterator[Item]:
    """The frames of JSON lines, each as soon as its line is complete.

    Args:
        chunks: the bytes, cut anywhere.
        where: the name of their source in messages.
    """
    header: dict[str, Any] = {}
    for number, line in enumerate(_lines(chunks), start=1):
        place = f"{where}, line {number}"
        if line is None:
            found = f"is longer than {MAX_LINE_BYTES} bytes"
            yield refused(place, f"{found}; send one frame a line, or fewer correspondences")
        elif line.strip():
            parsed = _parse(line.removeprefix(b"\xef\xbb\xbf"), place, header)
            if isinstance(parsed, dict):
                header = parsed
            else:
                yield parsed


def _lines(chunks: Iterable[bytes]) -> Iterator[bytes | None]:
    """Lines without their ends; None, at once, for one that is too long: its rest is skipped."""
    kept, too_long = bytearray(), False
    for chunk in chunks:
        *ends, rest = chunk.split(b"\n")
        for end in ends:
            kept += end
            if not too_long:
                yield bytes(kept) if len(kept) <= MAX_LINE_BYTES else None
            kept, too_long = bytearray(), False
        kept += rest
        if len(kept) > MAX_LINE_BYTES:
            if not too_long:
                yield None
            kept, too_long = bytearray(), True
    if kept and not too_long:
        yield bytes(kept)


def _parse(line: bytes, where: str, header: Mapping[str, Any]) -> Item | dict[str, Any]:
    """A frame, why it is none, or the metadata of a header."""
    try:
        content = from_json(line, allow_inf_nan=False)
        if isinstance(content, dict) and content.keys() == {"metadata"}:
            metadata = HeaderLine.model_validate(content).metadata
            MatcherFindings.from_metadata(metadata)
            return metadata
        return replace(FrameLine.model_validate(content).to_frame(header), where=where)
    except ValidationError as error:
        return refused(where, describe(error))
    except CorrespondenceError as error:
        return refused(where, error.without_row, by_motion=isinstance(error, MotionError))
    except ValueError as error:
        return refused(where, f"is not JSON ({error}); send one frame a line, as JSON")
