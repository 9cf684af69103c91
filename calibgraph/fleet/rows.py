"""The rows of a fleet: one per vehicle and camera, in Parquet files at a URI.

A vehicle's rows are in the file of its bucket, ``bucket=HH/rows.parquet``, which is replaced as a
whole: a reader finds every row once, whatever ends the writer.
"""

import fcntl
import hashlib
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import compute, parquet

from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import require_place_for_folder, write_bytes
from calibgraph.fleet.uris import in_arrow, is_local, locate

FLEET_FORMAT = "calibgraph-fleet/1"
BUCKETS = 256
_LOCK = ".lock"
_READERS = 16  # threads: a get of an object store takes 50 ms
JOB_KEY = ("vehicle", "recording")
"""A job of a manifest is known by its vehicle and its recordings."""

SCHEMA = pa.schema(
    [
        ("vehicle", pa.string()),
        ("camera", pa.string()),
        ("status", pa.string()),
        ("verdict", pa.string()),
        ("cannot_tell", pa.bool_()),
        ("probability_off", pa.float64()),
        ("reasons", pa.list_(pa.string())),
        ("actions", pa.list_(pa.string())),
        ("T_camera_lidar", pa.list_(pa.float64(), 16)),
        ("covariance", pa.list_(pa.float64(), 36)),
        ("of", pa.string()),
        ("error_kind", pa.string()),
        ("error", pa.string()),
        ("seconds", pa.float64()),
        ("recording", pa.string()),
        ("input_hash", pa.string()),
        ("versions", pa.string()),
    ],
    metadata={"format": FLEET_FORMAT},
)
"""probability_off: by more than the tolerance. T_camera_lidar: (4, 4) by rows, null when failed;
covariance: (6, 6) of xi in T_camera_lidar = exp(xi) estimate, null without an error bar; of:
alignment or mount, null in rows of earlier versions, which are alignments. A vehicle that failed
before its cameras were known has one row with an empty camera."""


def read_rows(uri: str, storage_options: Mapping[str, Any] | None = None) -> pa.Table:
    """All rows at a URI.

    Args:
        uri: a Parquet file, or a folder of them, hive-partitioned or not; local or of fsspec.
        storage_options: of fsspec.

    Raises:
        FileError: if nothing is there, or it cannot be read.
    """
    import fsspec

    try:
        filesystem, path = fsspec.core.url_to_fs(uri, **dict(storage_options or {}))
        files = [path] if filesystem.isfile(path) else _files_below(filesystem, path)
        if not files:
            raise FileNotFoundError("no Parquet file is there")
        with ThreadPoolExecutor(_READERS) as pool:
            tables = [*pool.map(lambda file: _read_file(filesystem, file), files)]
        # A manifest of a later run may have further columns.
        return pa.concat_tables(tables, promote_options="permissive")
    except (OSError, ValueError, ImportError, pa.ArrowException) as error:
        raise FileError(
            uri, f"cannot be read as a fleet's rows ({error}); give what calibgraph fleet wrote"
        ) from error


def _files_below(filesystem: Any, path: str) -> list[str]:
    """The Parquet files in a folder, but for those that are hidden or in hidden folders."""
    found = sorted(map(str, filesystem.find(path)))
    return [name for name in found if name.endswith(".parquet") and not _is_hidden(name, path)]


def _is_hidden(name: str, folder: str) -> bool:
    return any(part[:1] in (".", "_") for part in name.removeprefix(folder).split("/"))


def _read_file(filesystem: Any, path: str) -> pa.Table:
    """A whole file at once: a run may replace it meanwhile."""
    return parquet.ParquetFile(in_arrow(filesystem.cat_file(path))).read()


def bucket_of(vehicle: str) -> int:
    """The bucket of a vehicle, from 0 to 255: by the hash of its name."""
    return hashlib.sha256(vehicle.encode()).digest()[0]


class RowStore:
    """The rows at a URI.

    Writers of one bucket on local disks wait for each other; on an object store, which has no
    locks, the last one of two at the same moment wins.

    Raises:
        CalibrationError: if it is empty, or nothing can be written there.
    """

    def __init__(self, uri: str) -> None:
        if not uri:
            raise CalibrationError("--out is empty; name a folder or URI for the rows")
        self.uri = uri
        self._filesystem, self._path = locate(uri)
        self._is_local = is_local(self._filesystem)
        if self._is_local:
            require_place_for_folder(Path(self._path))

    def read(self, bucket: int, columns: Sequence[str] | None = None) -> pa.Table | None:
        """The rows of a bucket, None if there are none.

        Raises:
            FileError: if a file is there that is not of a fleet of this format.
        """
        path = self._file(bucket)
        if not self._filesystem.exists(path):
            return None
        content = in_arrow(self._filesystem.cat_file(path))
        try:
            file = parquet.ParquetFile(content)
            found = (file.schema_arrow.metadata or {}).get(b"format", b"").decode()
            if found == FLEET_FORMAT:
                return file.read(columns=None if columns is None else list(columns))
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
        numbers = pa.array([bucket_of(name.as_py()) for name in rows["vehicle"]])
        with self._locked():
            for number in compute.unique(numbers).to_pylist():
                self._replace(number, rows.filter(compute.equal(numbers, number)))

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Let no other process replace files meanwhile; those that end give their lock back."""
        if not self._is_local:
            yield
            return
        Path(self._path).mkdir(parents=True, exist_ok=True)
        with (Path(self._path) / _LOCK).open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _replace(self, bucket: int, rows: pa.Table) -> None:
        before = self.read(bucket)
        if before is not None:
            new = set(job_keys(rows))
            kept = pa.array([key not in new for key in job_keys(before)], pa.bool_())
            rows = pa.concat_tables([before.filter(kept), rows], promote_options="permissive")
        self.put(f"bucket={bucket:02x}/rows.parquet", _encode(rows))

    def put(self, name: str, content: bytes) -> None:
        """Write a file below the URI in one step."""
        path = f"{self._path}/{name}"
        if self._is_local:
            write_bytes(Path(path), content)
        else:
            self._filesystem.pipe_file(path, content)

    def _file(self, bucket: int) -> str:
        return f"{self._path}/bucket={bucket:02x}/rows.parquet"


def job_keys(rows: pa.Table) -> Iterable[tuple[str, ...]]:
    """Per row, the key of its job."""
    return zip(*(rows[name].to_pylist() for name in JOB_KEY), strict=True)


def _encode(rows: pa.Table) -> bytes:
    """Rows as a Parquet file, the rows of a job together."""
    metadata = {**(rows.schema.metadata or {}), "format": FLEET_FORMAT}
    sink = io.BytesIO()
    parquet.write_table(
        rows.replace_schema_metadata(metadata), sink, write_statistics=False, compression="zstd"
    )
    return sink.getvalue()
