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
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import from_json

from calibgraph.errors import CorrespondenceError
from calibgraph.files import describe
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.table_columns import COORDINATES, INFORMATION, as_confidence
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
    confidence: list[float] = []
    i_uu_px: list[float] = []
    i_uv_px: list[float] = []
    i_vv_px: list[float] = []
    point_index: list[Int64] = []

    @model_validator(mode="after")
    def _require_whole_table(self) -> Self:
        partial = sorted(self.model_fields_set.intersection(INFORMATION))
        if partial and len(partial) < len(INFORMATION):
            raise ValueError(f"has only {partial} of {list(INFORMATION)}; add all")
        lengths = {key: len(getattr(self, key)) for key in self.given}
        if len(set(lengths.values())) > 1:
            raise ValueError(f"the lists differ in length: {lengths}")
        return self

    @property
    def given(self) -> tuple[str, ...]:
        """The columns that the line has, in the order of the model."""
        return tuple(key for key in type(self).model_fields if key in self.model_fields_set)

    def table(
        self, camera: str, frame: int, stamp_ns: int | None, *, indexed: bool
    ) -> Correspondences:
        """The correspondences of this camera; ``indexed``: with the index of each point, or -1.

        Raises:
            CorrespondenceError: if a value is out of its range.
        """
        n = len(self.u_px)
        confidence = self.confidence if "confidence" in self.given else np.ones(n)
        informed = INFORMATION[0] in self.given
        return Correspondences(
            cameras=(camera,),
            camera_index=np.zeros(n, np.int32),
            frame=np.full(n, frame, np.int64),
            pixels_px=self._stack(COORDINATES[:2]),
            points_lidar_m=self._stack(COORDINATES[2:]),
            confidence=as_confidence(np.array(confidence, np.float64)),
            information_px=self._stack(INFORMATION) if informed else None,
            stamp_ns=None if stamp_ns is None else np.full(n, stamp_ns, np.int64),
            point_index=np.array(self.point_index or [-1] * n, np.int64) if indexed else None,
        )

    def _stack(self, keys: Sequence[str]) -> NDArray[np.float64]:
        return np.stack([np.array(getattr(self, key), np.float64) for key in keys], axis=1)


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
    metadata: dict[str, Any] = {}

    def to_frame(self, header: Mapping[str, Any]) -> StreamFrame:
        """The frame with the correspondences of all its cameras.

        Args:
            header: metadata of all frames, which its own replaces key by key.

        Raises:
            CorrespondenceError: if a value is out of its range.
        """
        stamp_ns = self.stamp_ns if "stamp_ns" in self.model_fields_set else None
        indexed = any("point_index" in columns.given for columns in self.cameras.values())
        tables = [
            columns.table(camera, self.frame, stamp_ns, indexed=indexed)
            for camera, columns in self.cameras.items()
        ]
        table = concatenate(tables) if tables else _EMPTY
        table = table.with_metadata({**header, **self.metadata})
        if self.twist_per_s is not None:
            table = replace(table, twist_per_s=np.tile(self.twist_per_s, (len(table), 1)))
        return StreamFrame(self.frame, with_place(table, self.place))


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
            parsed = _parse(line, place, header)
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
        return FrameLine.model_validate(content).to_frame(header)
    except ValidationError as error:
        return refused(where, describe(error))
    except CorrespondenceError as error:
        return refused(where, str(error))
    except ValueError as error:
        return refused(where, f"is not JSON ({error}); send one frame a line, as JSON")


_EMPTY = Correspondences(
    cameras=(),
    camera_index=np.empty(0, np.int32),
    frame=np.empty(0, np.int64),
    pixels_px=np.empty((0, 2)),
    points_lidar_m=np.empty((0, 3)),
    confidence=np.empty(0, np.float32),
)
