"""A session of picking: pairs of a pixel and a point, undo and redo, saved after every change."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text, write_text
from calibgraph.model.correspondences import MAX_COORDINATE, Correspondences

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE, allow_inf_nan=False)]

PICK_SIGMA_PX = 1.0
"""Standard deviation of a pixel picked with the loupe, per axis, unless it is given."""


class Pair(BaseModel):
    """A pixel and the LiDAR point that it shows.

    Attributes:
        frame: number of the frame in the dataset.
        camera: name.
        pixel_px: (column, row) in the image as recorded.
        point_index: row of the point in the frame's cloud.
        sigma_px: standard deviation of the pixel per axis.
        used: whether it takes part in the estimate.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    frame: Annotated[int, Field(ge=0, lt=2**31)]
    camera: Annotated[str, Field(max_length=100)]
    pixel_px: tuple[Coordinate, Coordinate]
    point_index: Annotated[int, Field(ge=0, lt=2**31)]
    point_lidar_m: tuple[Coordinate, Coordinate, Coordinate]
    sigma_px: Annotated[float, Field(ge=0.05, le=100, allow_inf_nan=False)] = PICK_SIGMA_PX
    used: bool = True


def pixels_of(pairs: Sequence[Pair]) -> Array:
    """(n, 2) pixels."""
    return np.array([pair.pixel_px for pair in pairs], dtype=np.float64).reshape(-1, 2)


def points_of(pairs: Sequence[Pair]) -> Array:
    """(n, 3) points in the LiDAR frame."""
    return np.array([pair.point_lidar_m for pair in pairs], dtype=np.float64).reshape(-1, 3)


def sigmas_of(pairs: Sequence[Pair]) -> Array:
    """(n,) standard deviations of the pixels."""
    return np.array([pair.sigma_px for pair in pairs], dtype=np.float64)


def to_table(pairs: Sequence[Pair]) -> Correspondences:
    """The used pairs as a table of correspondences; the information is 1 / sigma^2."""
    used = [pair for pair in pairs if pair.used]
    weight = sigmas_of(used) ** -2
    return Correspondences.from_arrays(
        camera=np.array([pair.camera for pair in used], dtype=np.str_),
        frame=np.array([pair.frame for pair in used], dtype=np.int64),
        pixels_px=pixels_of(used),
        points_lidar_m=points_of(used),
        information_px=np.column_stack([weight, np.zeros_like(weight), weight]),
        point_index=np.array([pair.point_index for pair in used], dtype=np.int64),
        metadata={"name": "pick"},
    )


SESSION_FILE = "session.json"
SESSION_FORMAT: Literal["calibgraph-pick/1"] = "calibgraph-pick/1"
MAX_UNDO = 100
MAX_PAIRS = 2000  # by hand

Pairs = tuple[Pair, ...]


class Session(BaseModel):
    """The pairs, and what they were before and after.

    Attributes:
        dataset: names of the dataset's frames, by which a session is known to fit it.
        cameras: the rig's.
        revision: counts the changes.
        pairs: in the order in which they were picked.
        past, future: earlier states for undo, and those undone for redo.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["calibgraph-pick/1"] = SESSION_FORMAT
    dataset: tuple[str, ...]
    cameras: tuple[str, ...]
    revision: int = 0
    pairs: Pairs = ()
    past: tuple[Pairs, ...] = ()
    future: tuple[Pairs, ...] = ()

    def with_pairs(self, pairs: Sequence[Pair]) -> Session:
        """The session with other pairs, which undo takes back."""
        past = (*self.past, self.pairs)[-MAX_UNDO:]
        return self._changed(tuple(pairs), past, ())

    def undone(self) -> Session:
        """One change back; the same session if there is none."""
        if not self.past:
            return self
        return self._changed(self.past[-1], self.past[:-1], (self.pairs, *self.future))

    def redone(self) -> Session:
        """One undone change again; the same session if there is none."""
        if not self.future:
            return self
        return self._changed(self.future[0], (*self.past, self.pairs), self.future[1:])

    def _changed(self, pairs: Pairs, past: tuple[Pairs, ...], future: tuple[Pairs, ...]) -> Session:
        return self.model_copy(
            update={
                "revision": self.revision + 1, "pairs": pairs, "past": past, "future": future
            }
        )  # fmt: skip

    def save(self, path: Path) -> None:
        """Write the session atomically."""
        write_text(path, json.dumps(self.model_dump(), separators=(",", ":")) + "\n")


def load_session(path: Path) -> Session:
    """Read a session."""
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"is not JSON ({error}); move it away to begin anew") from error
    return checked_model(Session, content, path)


def open_session(path: Path, frames: Sequence[str], cameras: Sequence[str]) -> Session:
    """The session of a file, or a new one.

    Raises:
        FileError: if the file is of another dataset or no session.
    """
    if not path.exists():
        return Session(dataset=tuple(frames), cameras=tuple(cameras))
    session = load_session(path)
    if session.dataset != tuple(frames) or session.cameras != tuple(cameras):
        raise FileError(
            path,
            "is a session of other frames or cameras; give the same --frames, or another --out",
        )
    return session
