"""The rows of a fleet: one per vehicle and camera, in Parquet files at a URI.

A vehicle's rows are in the file of its bucket, ``bucket=HH/rows.parquet``, which is replaced as a
whole: a reader finds every row once, whatever ends the writer.
"""

import fcntl
import hashlib
import io
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
from pyarrow import compute, parquet

from calibgraph.errors import CalibrationError, FileError
from calibgraph.file_sets import require_own_folder
from calibgraph.files import require_place_for_folder, write_bytes
from calibgraph.fleet.uris import in_arrow, is_local, locate

FLEET_FORMAT = "calibgraph-fleet/1"
_FILE, _LOCK = "rows.parquet", ".lock"
_READERS = 16  # threads: a get of an object store takes 50 ms

_NUMBERS = {"T_camera_lidar": 16, "covariance": 36}
_TEXTS = ("vehicle", "camera", "status", "verdict", "of", "error_kind", "error", "recording",
          "input_hash", "versions")  # fmt: skip
SCHEMA = pa.schema(
    [
        *((name, pa.string()) for name in _TEXTS),
        ("cannot_tell", pa.bool_()),
        *((name, pa.list_(pa.string())) for name in ("reasons", "actions")),
        *((name, pa.list_(pa.float64(), size)) for name, size in _NUMBERS.items()),
        *((name, pa.float64()) for name in ("probability_off", "seconds")),
    ],
    metadata={"format": FLEET_FORMAT},
)
"""T_camera_lidar: (4, 4) by rows, null when failed; covariance: (6, 6) of xi in T_camera_lidar =
exp(xi) estimate, null without an error bar; of: alignment or mount. A vehicle that failed before
its cameras were known has one row with an empty camera."""


def read_rows(uri: str) -> pa.Table:
    """All rows at a URI: a folder that ``calibgraph fleet`` wrote, or one Parquet file.

    Raises:
        FileError: if nothing is there, or it cannot be read.
    """
    try:
        filesystem, path = locate(uri)
        files = [path] if filesystem.isfile(path) else sorted(
            name for name in filesystem.find(path) if name.endswith(f"/{_FILE}")
        )  # fmt: skip
        if not files:
            raise FileNotFoundError("no Parquet file is there")
        with ThreadPoolExecutor(_READERS) as pool:  # each whole: a run may replace it meanwhile
            contents = [*pool.map(filesystem.cat_file, files)]
        tables = [parquet.ParquetFile(in_arrow(content)).read() for content in contents]
        # A manifest of a later run may have further columns.
        return pa.concat_tables(tables, promote_options="permissive")
    except (OSError, ValueError, ImportError, pa.ArrowException) as error:
        raise FileError(
            uri, f"cannot be read as a fleet's rows ({error}); give what calibgraph fleet wrote"
        ) from error


def bucket_of(vehicle: str) -> int:
    """The bucket of a vehicle, from 0 to 255: by the hash of its name."""
    return hashlib.sha256(vehicle.encode()).digest()[0]


class RowStore:
    """The rows at a URI; one command writes there at a time, which an object store cannot check.

    Raises:
        CalibrationError: if the URI is empty, or nothing can be written there.
    """

    def __init__(self, uri: str) -> None:
        if not uri:
            raise CalibrationError("--out is empty; name a folder or URI for the rows")
        self.uri = uri
        self._filesystem, self._path = locate(uri)
        self._is_local = is_local(self._filesystem)
        if self._is_local:
            require_place_for_folder(Path(self._path))

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Let no other command write to this folder meanwhile; one that ends gives it back."""
        if not self._is_local:
            yield
            return
        if not (Path(self._path) / _LOCK).exists():
            require_own_folder(Path(self._path))
        Path(self._path).mkdir(parents=True, exist_ok=True)
        with (Path(self._path) / _LOCK).open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise FileError(
                    self.uri, "another command writes there; wait for its end, or choose another "
                    "--out"
                ) from error  # fmt: skip
            yield

    def read(self, bucket: int) -> pa.Table:
        """The rows of a bucket.

        Raises:
            FileError: if a file is there that is not of a fleet of this format.
        """
        path = f"{self._path}/bucket={bucket:02x}/{_FILE}"
        if not self._filesystem.exists(path):
            return SCHEMA.empty_table()
        try:
            file = parquet.ParquetFile(in_arrow(self._filesystem.cat_file(path)))
            found = (file.schema_arrow.metadata or {}).get(b"format", b"").decode()
            if found == FLEET_FORMAT:
                return file.read()
        except (pa.ArrowException, OSError) as error:
            found = str(error)
        raise FileError(
            path, f"is not of a fleet of format {FLEET_FORMAT} ({found or 'no format'}); "
            "choose another --out"
        )  # fmt: skip

    def publish(self, rows: pa.Table) -> None:
        """Add rows; earlier rows of the same vehicle and recordings are replaced.

        Each bucket's file is replaced in one step: by a rename of a synced file, or on an object
        store by one put.
        """
        numbers, new = pa.array([bucket_of(v.as_py()) for v in rows["vehicle"]]), {*job_keys(rows)}
        for number in compute.unique(numbers).to_pylist():
            before = self.read(number)
            kept = before.filter(pa.array([key not in new for key in job_keys(before)], pa.bool_()))
            own = rows.filter(compute.equal(numbers, number))
            own = pa.concat_tables([kept, own], promote_options="permissive")
            metadata = {**(own.schema.metadata or {}), "format": FLEET_FORMAT}
            self.put(f"bucket={number:02x}/{_FILE}", encode(own.replace_schema_metadata(metadata)))

    def put(self, name: str, content: bytes) -> None:
        """Write a file below the URI in one step."""
        path = f"{self._path}/{name}"
        if self._is_local:
            write_bytes(Path(path), content)
        else:
            self._filesystem.pipe_file(path, content)


def job_keys(rows: pa.Table) -> Iterable[tuple[str, str]]:
    """Per row, the key of its job: vehicle and recordings."""
    return zip(rows["vehicle"].to_pylist(), rows["recording"].to_pylist(), strict=True)


def encode(rows: pa.Table) -> bytes:
    """A table as a Parquet file."""
    sink = io.BytesIO()
    parquet.write_table(rows, sink, write_statistics=False, compression="zstd")
    return sink.getvalue()
