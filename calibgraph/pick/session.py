"""The pairs of a session, kept in a file after every change."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_json, write_text
from calibgraph.model.correspondences import Correspondences

SESSION_FILE = "session.json"
SESSION_FORMAT: Literal["calibgraph-pick/2"] = "calibgraph-pick/2"
_Number = Annotated[float, Field(ge=-1e6, le=1e6)]


class Pair(BaseModel):
    """A pixel and a point of the cloud that are one place.

    Attributes:
        frame: number of the frame.
        camera: its name.
        pixel_px: (column, row).
        point_lidar_m: in the LiDAR frame.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    frame: Annotated[int, Field(ge=0)]
    camera: str
    pixel_px: tuple[_Number, _Number]
    point_lidar_m: tuple[_Number, _Number, _Number]


class Session(BaseModel):
    """The pairs, with the frames and cameras of their dataset.

    Attributes:
        frames: names, by which a session is known to fit a dataset.
        cameras: the rig's.
        pairs: in the order in which they were picked.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["calibgraph-pick/2"] = SESSION_FORMAT
    frames: tuple[str, ...]
    cameras: tuple[str, ...]
    pairs: Annotated[tuple[Pair, ...], Field(max_length=2000)] = ()

    def save(self, path: Path) -> None:
        """Write the session; the file is whole or as before."""
        write_text(path, json.dumps(self.model_dump(), separators=(",", ":")) + "\n")


def open_session(path: Path, frames: Sequence[str], cameras: Sequence[str]) -> Session:
    """The session of a file, or a new one.

    Raises:
        FileError: if the file is of another dataset or no session.
    """
    new = Session(frames=tuple(frames), cameras=tuple(cameras))
    if not path.exists():
        return new
    session = checked_model(Session, read_json(path), path)
    if (session.frames, session.cameras) != (new.frames, new.cameras):
        raise FileError(
            path,
            "is a session of other frames or cameras; give the same --frames, or another --out",
        )
    return session


def to_table(pairs: Sequence[Pair], **further: str) -> Correspondences:
    """The pairs as a table of correspondences; their frames share no error of a matcher."""
    return Correspondences.from_arrays(
        camera=np.array([pair.camera for pair in pairs], dtype=np.str_),
        frame=np.array([pair.frame for pair in pairs], dtype=np.int64),
        pixels_px=np.array([pair.pixel_px for pair in pairs]),
        points_lidar_m=np.array([pair.point_lidar_m for pair in pairs]),
        metadata={
            "matcher": "pick", "systematic_rotation_rad": 0.0, "systematic_translation_m": 0.0,
            **further,
        },
    )  # fmt: skip
