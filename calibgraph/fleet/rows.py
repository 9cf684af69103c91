"""The rows of a fleet: one per vehicle and camera, in a Parquet file per job at a URI.

The file of a job is replaced as a whole: a reader finds every row once, whatever ends the writer.
"""

import fcntl
import io
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pyarrow as pa
from pyarrow import parquet

from calibgraph.errors import CalibrationError, FileError
from calibgraph.file_sets import require_own_folder
from calibgraph.files import require_place_for_folder, write_bytes
from calibgraph.fleet.uris import in_arrow, is_local, locate

ROWS = "rows"
_LOCK = ".lock"
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
    metadata={"format": "calibgraph-fleet/2"},
)
"""T_camera_lidar: (4, 4) by rows, null when failed; covariance: (6, 6) of xi in T_camera_lidar =
exp(xi) estimate, null without an error bar; of: alignment or mount. A vehicle that failed before
its cameras were known has one row with an empty camera."""


def read_rows(uri: str, *, may_be_new: bool = False) -> pa.Table:
    """All rows at a URI: a folder that ``calibgraph fleet`` wrote, or one Parquet file.

    Args:
        uri: folder or file.
        may_be_new: no rows if nothing is there.

    Raises:
        FileError: if nothing is there, or it cannot be read.
    """
    try:
        filesystem, path = locate(uri)
        files = [path] if filesystem.isfile(path) else sorted(
            name for name in filesystem.find(f"{path}/{ROWS}")
            if name.endswith(".parquet") and "/." not in name.removeprefix(path)
        )  # fmt: skip
        if not files and may_be_new:
            return SCHEMA.empty_table()
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


class Store:
    """The files at a URI; one command writes there at a time, which an object store cannot check.

    Raises:
        CalibrationError: if the URI is empty, or nothing can be written there.
    """

    def __init__(self, uri: str) -> None:
        if not uri:
            raise CalibrationError("--out is empty; name a folder or URI for the rows")
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
                why = "another command writes there; wait for its end, or choose another --out"
                raise FileError(self._path, why) from error
            yield

    def put(self, name: str, content: bytes | pa.Table) -> None:
        """Write a file below the URI, a table as Parquet.

        In one step: by a rename of a synced file, or on an object store by one put.
        """
        if isinstance(content, pa.Table):
            sink = io.BytesIO()
            parquet.write_table(content, sink, write_statistics=False, compression="zstd")
            content = sink.getvalue()
        path = f"{self._path}/{name}"
        if self._is_local:
            write_bytes(Path(path), content)
        else:
            self._filesystem.pipe_file(path, content)
