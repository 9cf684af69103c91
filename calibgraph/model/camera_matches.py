"""The table of camera-camera matches: features that two cameras see at one instant."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, name_cells
from calibgraph.model.correspondences import CAMERA_INDEX, MAX_COORDINATE, Column, Table

if TYPE_CHECKING:
    import pyarrow as pa


NAMES = ("camera_a", "camera_b")
NUMBERS = ("u_a_px", "v_a_px", "u_b_px", "v_b_px")
PLANES = tuple(f"q{axis}_{side}_per_m" for side in "ab" for axis in "xyz")


@dataclass(frozen=True, eq=False, repr=False)
class CameraMatches(Table):
    """Features that two cameras see at one instant, as columns of equal length.

    Sides: 0 is camera A, 1 is camera B. A plane q, with q . p = 1 for its points p in the LiDAR
    frame, is fitted to the LiDAR's points that project next to the feature, under an estimate of
    the camera's extrinsic. The feature is where its ray meets the plane.

    Attributes:
        cameras: the names that ``camera_index`` counts.
        camera_index: (n, 2) which of ``cameras`` are A and B; A comes before B.
        frame: (n,) frame number.
        pixels_px: (n, 2, 2) per side, the pixel (column, row) in the image as recorded.
        planes_lidar_per_m: (n, 2, 3) per side, q [1/m]; NaN where there is none.
        metadata: the settings of the matcher.

    Raises:
        CorrespondenceError: on wrong shapes or values, naming the first bad row.
    """

    cameras: tuple[str, ...]
    camera_index: NDArray[np.int32]
    frame: NDArray[np.int64]
    pixels_px: Array
    planes_lidar_per_m: Array
    metadata: dict[str, Any] = field(default_factory=dict)

    FORMAT: ClassVar[str] = "calibgraph-camera-matches/1"
    COLUMNS: ClassVar[Mapping[str, Column]] = {
        CAMERA_INDEX: Column(NAMES, "i4"),
        "frame": Column(("frame",), "i8"),
        "pixels_px": Column(NUMBERS, shape=(2, 2)),
        "planes_lidar_per_m": Column(PLANES, shape=(2, 3), gaps=True),
    }

    def __post_init__(self) -> None:
        self._check_shapes()
        self._check_values()

    @staticmethod
    def empty(cameras: Sequence[str], metadata: dict[str, Any] | None = None) -> CameraMatches:
        """A table without rows."""
        of = CameraMatches.COLUMNS.items()
        columns: dict[str, Any] = {name: np.empty((0, *c.of_row), c.kind) for name, c in of}
        return CameraMatches(cameras=tuple(cameras), metadata=metadata or {}, **columns)

    def __repr__(self) -> str:
        counts = ", ".join(f"{a}-{b}: {len(self.of_pair(a, b))}" for a, b in self.pairs())
        return f"CameraMatches({counts}; {len(np.unique(self.frame))} frames)"

    def pairs(self) -> list[tuple[str, str]]:
        """The pairs of cameras that have matches, A before B."""
        first = np.unique(name_cells(self.camera_index), return_index=True)[1]
        return [(self.cameras[a], self.cameras[b]) for a, b in self.camera_index[first]]

    def of_pair(self, a: str, b: str) -> CameraMatches:
        """The rows of one pair, A and B in the order of ``cameras``; none if it has none."""
        return self.select(self.rows_of_pair(a, b))

    def rows_of_pair(self, a: str, b: str) -> NDArray[np.intp]:
        """The numbers of these rows."""
        if a not in self.cameras or b not in self.cameras:
            return np.empty(0, np.intp)
        wanted = [self.cameras.index(a), self.cameras.index(b)]
        return np.flatnonzero((self.camera_index == wanted).all(axis=1))

    def to_arrow(self) -> pa.Table:
        """The table in the file format's columns; its metadata name cameras without a row, too."""
        found = super().to_arrow()
        names = {b"cameras": json.dumps(self.cameras)}
        return found.replace_schema_metadata({**found.schema.metadata, **names})

    def _check_values(self) -> None:
        index, count = self.camera_index, len(self.cameras)
        ordered = (index[:, 0] < index[:, 1]) & (index >= 0).all(axis=1) & (index < count).all(1)
        self._require(ordered, "camera_index", index, f"count the {count} cameras, A before B")
        pixels = self.pixels_px.reshape(-1, 4)
        small = (np.abs(pixels) < MAX_COORDINATE).all(axis=1)
        self._require(small, "pixel", pixels, f"be finite and below {MAX_COORDINATE:g}")
        planes = self.planes_lidar_per_m
        there = np.isfinite(planes).all(axis=2) & np.any(planes != 0, axis=2)
        good = np.all(there | np.isnan(planes).all(axis=2), axis=1)
        self._require(good, "planes_lidar_per_m", planes, "be finite and not zero, or NaN")


def concatenate_camera_matches(tables: Iterable[CameraMatches]) -> CameraMatches:
    """Concatenate tables of the same cameras; the first gives the metadata.

    Raises:
        ValueError: if there are none, or their cameras differ.
    """
    given = list(tables)
    if len({table.cameras for table in given}) != 1:
        raise ValueError("expected tables of the same cameras")
    columns = {
        name: np.concatenate([getattr(t, name) for t in given]) for name in CameraMatches.COLUMNS
    }
    return CameraMatches(cameras=given[0].cameras, metadata=given[0].metadata, **columns)
