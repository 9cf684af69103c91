"""The correspondence table, in memory and on disk: matchers write it, the solver reads it."""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError, MotionError
from calibgraph.files import write_atomically
from calibgraph.model.findings import MatcherFindings, joined_metadata
from calibgraph.model.places import KEYS, Places

if TYPE_CHECKING:
    import pyarrow as pa

COORDINATES = ("u_px", "v_px", "x_m", "y_m", "z_m")
INFORMATION = ("i_uu_px", "i_uv_px", "i_vv_px")
TWIST = ("wx_rad_s", "wy_rad_s", "wz_rad_s", "vx_m_s", "vy_m_s", "vz_m_s")
TWISTS, LATE = "twist_per_s", "late_s"
MAX_LATE_S = 10.0  # of no image and cloud that belong together
MAX_TWIST = 6.0, 100.0  # rad/s and m/s: beyond those of a vehicle; swapped ones are seen
TWIST_RULE = "be under 6 rad/s, then under 100 m/s (rotation first, in radians)"

MIN_INFORMATION, MAX_INFORMATION = 1e-12, 1e8  # 1/px^2: errors from 1e6 px down to 1e-4 px

WITHOUT_METADATA = (
    "CSV holds no metadata, so that places, errors that frames share and what the images said "
    "(calibgraph_images) are not known; .parquet keeps them"
)

_log = logging.getLogger(__name__)

MAX_COORDINATE = 1e6  # px or m: far beyond any image and any LiDAR's range


class Column(NamedTuple):
    """A column of a table in memory, which a file has as one column for each number of a row.

    Attributes:
        names: of these; of an index of cameras, they hold the cameras' names.
        kind: numpy's type of a number.
        shape: of a row; () or that of the names if it is None.
        required: whether a file must have it.
        gaps: whether it may be empty where a number is NaN.
    """

    names: tuple[str, ...]
    kind: str = "f8"
    shape: tuple[int, ...] | None = None
    required: bool = True
    gaps: bool = False

    @property
    def of_row(self) -> tuple[int, ...]:
        """The shape of a row."""
        several = len(self.names) > 1
        return (len(self.names),) * several if self.shape is None else self.shape


CAMERA_INDEX = "camera_index"


class Table:
    """Columns of equal length: what tables of points and of features have in common."""

    FORMAT: ClassVar[str]
    COLUMNS: ClassVar[Mapping[str, Column]]
    """Of the file, in its order, by their attributes."""
    cameras: tuple[str, ...]
    camera_index: NDArray[np.int32]
    frame: NDArray[np.int64]
    metadata: dict[str, Any]

    def _check_shapes(self) -> None:
        for name, of in self.COLUMNS.items():
            column, shape = getattr(self, name), (len(self), *of.of_row)
            if column is not None and column.shape != shape:
                raise CorrespondenceError(
                    f"{name} has shape {column.shape}, expected {shape} like the column frame"
                )

    def _require(self, good: Any, what: str, found: NDArray[Any], rule: str) -> None:
        if not good.all():
            row = int(np.flatnonzero(~good)[0])
            text = f"{what} must {rule}, found {found[row].tolist()}; drop or correct it"
            error = MotionError if rule is TWIST_RULE else CorrespondenceError
            camera = self.cameras[self.camera_index[row]] if self.camera_index.ndim == 1 else None
            raise error(text, camera=camera, frame=int(self.frame[row]), row=row)

    def __len__(self) -> int:
        return len(self.frame)

    def select(self, rows: NDArray[Any] | slice) -> Self:
        """The table with only some rows: a mask, an index array or a slice."""
        kept = object.__new__(type(self))  # not checked again: rows of a valid table are valid
        vars(kept).update(vars(self))
        if not isinstance(rows, slice) and rows.dtype == np.bool_:
            rows = np.flatnonzero(rows)
        for name in self.COLUMNS:
            column = getattr(self, name)
            if column is not None:
                some = column[rows] if isinstance(rows, slice) else column.take(rows, axis=0)
                vars(kept)[name] = some
        return kept

    def save(self, path: Path | str) -> None:
        """Write the table as Parquet, or as CSV if the name ends in .csv, atomically.

        CSV has no place for the metadata: a warning is logged.
        """
        write_table(self.to_arrow(), Path(path))

    def to_arrow(self) -> pa.Table:
        """The table in the file format's columns, its metadata in the schema."""
        import pyarrow as pa

        names, columns = pa.array(self.cameras, pa.string()), {}
        for attribute, of in self.COLUMNS.items():
            values = getattr(self, attribute)
            each = () if values is None else values.reshape(len(self), len(of.names)).T
            for name, numbers in zip(of.names, each, strict=False):
                column = pa.array(numbers, from_pandas=of.gaps)
                is_index = attribute == CAMERA_INDEX
                columns[name] = (
                    pa.DictionaryArray.from_arrays(column, names) if is_index else column
                )
        metadata = {"format": self.FORMAT, "matcher": json.dumps(self.metadata)}
        return pa.table(columns).replace_schema_metadata(metadata)


@dataclass(frozen=True, eq=False, repr=False)
class Correspondences(Table):
    """2D-3D correspondences of several cameras and frames, as columns of equal length.

    Attributes:
        cameras: the names that ``camera_index`` counts.
        camera_index: (n,) which of ``cameras`` saw the pixel.
        frame: (n,) frame number; the same number in two cameras is the same instant.
        pixels_px: (n, 2) pixel (column, row) in the image as recorded (distorted).
        points_lidar_m: (n, 3) point in the LiDAR frame.
        confidence: (n,) in (0, 1].
        information_px: (n, 3) or None: i_uu, i_uv, i_vv of the 2x2 information of the pixel
            [1/px^2], positive semidefinite; it may have rank one (an edge constrains only its
            normal). None stands for the identity.
        stamp_ns: (n,) or None: time of the frame.
        twist_per_s: (n, 6) or None: of the LiDAR in its axes, rotation [rad/s], translation [m/s].
        late_s: (n,) or None: how long after its pixel a point was taken [s], where clouds are not
            corrected for motion; zero while the vehicle stands. None of clouds of one instant.
        metadata: as the file has it: the matcher, its settings, its findings and the places.
        findings: the matcher's, read from the metadata.
        places: which frames share a place, read from the metadata.

    Raises:
        CorrespondenceError: on wrong shapes or values, naming the first bad row, and if the
            metadata has wrong ``findings`` or ``places``.
    """

    cameras: tuple[str, ...]
    camera_index: NDArray[np.int32]
    frame: NDArray[np.int64]
    pixels_px: Array
    points_lidar_m: Array
    confidence: NDArray[np.float32]
    information_px: Array | None = None
    stamp_ns: NDArray[np.int64] | None = None
    twist_per_s: Array | None = None
    late_s: Array | None = None
    metadata: dict[str, Any] = field(default_factory=dict)
    findings: MatcherFindings = field(init=False)
    places: Places = field(init=False)

    FORMAT: ClassVar[str] = "calibgraph-correspondences/1"
    COLUMNS: ClassVar[Mapping[str, Column]] = {
        CAMERA_INDEX: Column(("camera",), "i4"),
        "frame": Column(("frame",), "i8"),
        "pixels_px": Column(COORDINATES[:2]),
        "points_lidar_m": Column(COORDINATES[2:]),
        "confidence": Column(("confidence",), "f4", required=False),
        "stamp_ns": Column(("stamp_ns",), "i8", required=False),
        "information_px": Column(INFORMATION, required=False),
        TWISTS: Column(TWIST, required=False),
        LATE: Column((LATE,), required=False),
    }

    def __post_init__(self) -> None:
        self._check_shapes()
        if len(self.camera_index) and not (
            0 <= self.camera_index.min() <= self.camera_index.max() < len(self.cameras)
        ):
            raise CorrespondenceError(f"camera_index must count the cameras {self.cameras}")
        self._read(self.metadata)
        self._check_values()

    def _read(self, metadata: dict[str, Any]) -> None:
        """Take over a record of metadata, and read the typed parts of it."""
        if not isinstance(metadata, dict):
            raise CorrespondenceError(f"metadata must be a mapping, found {metadata!r}")
        object.__setattr__(self, "metadata", metadata)
        object.__setattr__(self, "findings", MatcherFindings.from_metadata(metadata))
        object.__setattr__(self, "places", Places.from_metadata(metadata))

    @staticmethod
    def from_arrays(
        *,
        camera: Sequence[str] | NDArray[np.str_] | str,
        frame: ArrayLike,
        pixels_px: ArrayLike,
        points_lidar_m: ArrayLike,
        confidence: ArrayLike | None = None,
        information_px: ArrayLike | None = None,
        stamp_ns: ArrayLike | None = None,
        twist_per_s: ArrayLike | None = None,
        metadata: dict[str, Any] | None = None,
    ) -> Correspondences:
        """Build a table from arrays; ``camera`` and ``frame`` may be one value for all rows.

        Raises:
            CorrespondenceError: on wrong shapes or values.
        """
        pixels = np.atleast_2d(np.asarray(pixels_px, dtype=np.float64))
        n = len(pixels)
        check_whole("frame", frame)
        check_whole("stamp_ns", stamp_ns)
        one = isinstance(camera, str) and n > 0  # not sorted, as the names of many rows are
        of_rows = np.asarray([camera] if one else np.broadcast_to(np.asarray(camera), n))
        names, index = np.unique(of_rows, return_inverse=True)
        return Correspondences(
            cameras=tuple(str(name) for name in names),
            camera_index=np.zeros(n, np.int32) if one else index.astype(np.int32),
            frame=np.array(np.broadcast_to(np.asarray(frame, dtype=np.int64), n)),
            pixels_px=pixels,
            points_lidar_m=np.asarray(points_lidar_m, dtype=np.float64),
            confidence=as_confidence(np.ones(n) if confidence is None else confidence),
            information_px=_optional(information_px, np.float64),
            stamp_ns=_optional(stamp_ns, np.int64),
            twist_per_s=_optional(twist_per_s, np.float64),
            metadata=metadata or {},
        )

    def __repr__(self) -> str:
        counts = ", ".join(f"{name}: {count}" for name, count in self.counts().items())
        return f"Correspondences({counts}; {len(np.unique(self.frame))} frames)"

    def of_camera(self, name: str) -> Correspondences:
        """The table of one camera alone (without rows, if it is not in this table)."""
        number = self.cameras.index(name) if name in self.cameras else -1
        own = self.select(rows_where(self.camera_index == number))
        object.__setattr__(own, "cameras", (name,))
        object.__setattr__(own, "camera_index", np.zeros_like(own.camera_index))
        return own

    def without_cameras(self, names: Collection[str]) -> Correspondences:
        """The rows of all other cameras."""
        left_out = [number for number, name in enumerate(self.cameras) if name in names]
        return self.select(~np.isin(self.camera_index, left_out)) if left_out else self

    @property
    def motion_column(self) -> str:
        """``twist_per_s``, if it has the motion of the LiDAR; else ``late_s`` or nothing."""
        return TWISTS if self.twist_per_s is not None else "" if self.late_s is None else LATE

    @property
    def is_swept(self) -> bool:
        """Whether points and pixels are apart in time while the motion is unknown.

        A lens or clock can then not be told from the motion.
        """
        return self.twist_per_s is None and self.late_s is not None and bool(self.late_s.any())

    @property
    def matcher(self) -> str:
        """The name of the matcher; empty if the table does not state it."""
        name = self.metadata.get("matcher")
        return name if isinstance(name, str) else ""

    def with_findings(self, findings: MatcherFindings) -> Correspondences:
        """The table with what these findings state; what they leave open stays as it is."""
        return self.with_metadata({**self.metadata, **findings.to_metadata()})

    def with_places(self, places: Places) -> Correspondences:
        """The table with other places."""
        kept = {key: value for key, value in self.metadata.items() if key not in KEYS}
        return self.with_metadata({**kept, **places.to_metadata()})

    def with_metadata(self, metadata: dict[str, Any]) -> Correspondences:
        """The same rows with another record of metadata.

        Raises:
            CorrespondenceError: if its findings or places are wrong.
        """
        changed = copy.copy(self)  # the columns are not checked again
        changed._read(metadata)
        return changed

    def counts(self) -> dict[str, int]:
        """Rows per camera."""
        counts = np.bincount(self.camera_index, minlength=len(self.cameras))
        return dict(zip(self.cameras, counts.tolist(), strict=True))

    def _check_values(self) -> None:
        for what, values in {"pixel": self.pixels_px, "point": self.points_lidar_m}.items():
            good = (np.abs(values) < MAX_COORDINATE).all(axis=1)
            self._require(good, what, values, f"be finite and below {MAX_COORDINATE:g}")
        if (twist := self.twist_per_s) is not None:
            self._require(np.isfinite(twist).all(axis=1), "twist", twist, "be finite")
            self._require(~beyond_vehicles(twist), "twist", twist, TWIST_RULE)
        if (late := self.late_s) is not None:
            self._require(np.abs(late) < MAX_LATE_S, LATE, late, f"be below {MAX_LATE_S:g} s")
        c = self.confidence
        self._require((c > 0) & (c <= 1), "confidence", c, "lie in (0, 1]")
        if self.information_px is not None:
            i = self.information_px
            good = (np.abs(i) < MAX_INFORMATION).all(axis=1)
            self._require(good, "information", i, f"be finite and below {MAX_INFORMATION:g}")
            rule = "be positive semidefinite and not zero"
            self._require(is_information(i), "information", i, rule)


def _optional(values: ArrayLike | None, dtype: type) -> Any:
    return None if values is None else np.asarray(values, dtype=dtype)


_FILLED = {"information_px": (1.0, 0.0, 1.0), LATE: 0.0}
"""What tables without it have beside others that have it; of other columns, then none has it."""


def concatenate(tables: Sequence[Correspondences]) -> Correspondences:
    """Concatenate tables; the first gives the metadata, but for findings that differ.

    Raises:
        ValueError: if there are none.
    """
    if not tables:
        raise ValueError("no tables to concatenate")
    names = tuple(sorted({name for table in tables for name in table.cameras}))
    parts, columns = [t for t in tables if len(t)] or [*tables[:1]], dict[str, Any]()
    for name, of in Correspondences.COLUMNS.items():
        given = [getattr(table, name) for table in parts]
        if name in _FILLED and any(column is not None for column in given):
            filled = (np.full((len(table), *of.of_row), _FILLED[name]) for table in parts)
            given = [a if b is None else b for a, b in zip(filled, given, strict=True)]
        columns[name] = None if any(c is None for c in given) else np.concatenate(given)
    pairs = [(np.array([names.index(n) for n in t.cameras], np.int32), t) for t in parts]
    numbers = [number[table.camera_index] for number, table in pairs]
    known = [table.metadata for table in tables if len(table) or table.metadata] or [{}]
    joined = tables[0].with_metadata(joined_metadata(known))
    columns |= {"cameras": names, CAMERA_INDEX: np.concatenate(numbers)}
    vars(joined).update(columns)  # as checked
    return joined


def check_whole(name: str, values: ArrayLike | None) -> None:
    """Check that a column holds whole numbers of 64 bits, if there is one.

    Raises:
        CorrespondenceError: if it does not.
    """
    array = np.asarray([] if values is None else values)
    if array.size and array.dtype.kind not in "iu":
        raise CorrespondenceError(f"{name} must hold whole numbers, found {values!r}")
    if array.size and array.max() >= 2**63:
        raise CorrespondenceError(f"{name} holds a number beyond 64 bits")


def is_information(uu_uv_vv: Array) -> NDArray[np.bool_]:
    """(n,) whether (n, 3) i_uu, i_uv, i_vv are positive semidefinite matrices and not zero."""
    uu, uv, vv = uu_uv_vv.T
    determinant, tolerance = uu * vv - uv**2, 1e-6 * np.maximum(uu, vv) ** 2
    positive = (uu >= 0) & (vv >= 0) & (determinant >= -tolerance)
    good: NDArray[np.bool_] = positive & (uu + vv > MIN_INFORMATION)
    return good


def beyond_vehicles(twist_per_s: Array) -> NDArray[np.bool_]:
    """(n,) whether (n, 6) motions are those of no vehicle."""
    lengths = np.linalg.norm(twist_per_s.reshape(-1, 2, 3), axis=2)
    beyond: NDArray[np.bool_] = (lengths >= MAX_TWIST).any(axis=1)
    return beyond


def write_table(arrow: pa.Table, path: Path) -> None:
    """Write a table as Parquet, or as CSV if the name ends in .csv, atomically.

    A warning is logged where CSV loses the metadata of a matcher.
    """
    from pyarrow import csv, parquet

    def write(part: Path) -> None:
        if path.suffix == ".csv":
            csv.write_csv(arrow, part)
        else:
            parquet.write_table(arrow, part, write_page_checksum=True)

    write_atomically(path, write)
    said = (arrow.schema.metadata or {}).get(b"matcher", b"{}")
    if path.suffix == ".csv" and said != b"{}":
        _log.warning("%s: %s", path, WITHOUT_METADATA)


def as_confidence(values: ArrayLike) -> NDArray[np.float32]:
    """Confidences in single precision; larger numbers become infinite, which is refused later."""
    with np.errstate(over="ignore"):
        return np.asarray(values, dtype=np.float32)


def rows_where(mask: NDArray[np.bool_]) -> NDArray[np.int64] | slice:
    """The rows of a mask; a slice, which makes a view, where they follow each other."""
    first, count = int(mask.argmax()) if len(mask) else 0, int(np.count_nonzero(mask))
    if mask[first : first + count].all():
        return slice(first, first + count)
    return np.flatnonzero(mask)
