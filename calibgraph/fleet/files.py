"""Files of a fleet: at local paths, or URIs of fsspec such as ``s3://bucket/drive``; and its rows.

There is a row per vehicle and camera, in a Parquet file per job at a URI. The file of a job is
replaced as a whole: a reader finds every row once, whatever ends the writer.
"""

import fcntl
import hashlib
import io
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
from pyarrow import parquet

from calibgraph.errors import CalibrationError, FileError, needs_extra
from calibgraph.files import require_own_folder, require_place_for_folder, sha256, write_bytes

_CHANGES = (
    "ETag", "etag", "generation", "md5Hash", "crc32c", "CRC", "size", "mtime", "LastModified",
    "last_modified", "created",
)  # fmt: skip
"""What stores report of a file that differs when the file does."""


def locate(uri: str) -> tuple[Any, str]:
    """The filesystem of a URI, and the path in it.

    Raises:
        FileError: if there is no such kind of URI, or its package is not installed.
    """
    with needs_extra("fleet", "files at URIs need fsspec"):
        import fsspec
    try:
        filesystem, path = fsspec.core.url_to_fs(uri)
    except (ImportError, ValueError, OSError) as error:
        raise FileError(uri, f"cannot be opened ({error})") from error
    return filesystem, str(path)


def in_arrow(content: bytes) -> pa.BufferReader:
    """A reader of a copy that Arrow owns.

    Arrow's threads drop what they read after a call has returned. If that is Python's, and Python
    is ending by then, it is aborted.
    """
    buffer = pa.allocate_buffer(len(content))
    memoryview(buffer).cast("B")[:] = content
    return pa.BufferReader(buffer)


def is_local(filesystem: Any) -> bool:
    """Whether the files of a filesystem are read in place."""
    from fsspec.implementations.local import LocalFileSystem

    return isinstance(filesystem, LocalFileSystem)


def join(folder: str, uri: str) -> str:
    """A URI; a relative path is below the folder."""
    if "://" in uri or "::" in uri or Path(uri).is_absolute():
        return uri
    return f"{folder}/{uri}" if folder else uri


def read_bytes(uri: str, most: int) -> bytes:
    """A whole file.

    Raises:
        FileError: if it is missing, cannot be read, or has more bytes than these.
    """
    filesystem, path = locate(uri)
    try:
        if filesystem.info(path)["type"] not in ("file", "directory"):
            raise FileError(uri, "is no file that can be read: a pipe, a device or a socket")
        size = filesystem.size(path)
        if size is not None and size > most:
            raise FileError(uri, f"{size} bytes is too large, expected up to {most}")
        return bytes(filesystem.cat_file(path))
    except FileNotFoundError as error:
        raise FileError(uri, "no such file; check the path") from error
    except IsADirectoryError as error:
        raise FileError(uri, "is a folder, expected a file") from error
    except CalibrationError:
        raise
    except Exception as error:  # of any store's client
        raise FileError(uri, f"cannot be read ({error})") from error


def fingerprint(uri: str) -> str:
    """SHA-256 of what is at a URI.

    Of the contents of local files; of the ETag, size and time of remote ones, which needs one
    listing and no byte of them.

    Raises:
        FileNotFoundError: if nothing is there.
    """
    filesystem, path = locate(uri)
    if not filesystem.exists(path):
        raise FileNotFoundError(uri)
    digest, is_here = hashlib.sha256(), is_local(filesystem)
    found = {path: filesystem.info(path)} if filesystem.isfile(path) else filesystem.find(
        path, detail=True
    )  # fmt: skip
    for name in sorted(found):
        state: Any = {key: str(found[name][key]) for key in _CHANGES if key in found[name]}
        if is_here and not Path(name).is_file():
            continue  # a pipe, or a link to nothing
        state = sha256(Path(name)) if is_here else state
        digest.update(json.dumps([name.removeprefix(path), state], sort_keys=True).encode())
    return digest.hexdigest()


def fetch(uri: str, folder: Path, most_bytes: float) -> Path:
    """The local path of a URI; remote data of at most ``most_bytes`` are copied into a new folder.

    Raises:
        FileError: if nothing is there, or too much.
        OSError: if it cannot be fetched: the next time it may work.
    """
    filesystem, path = locate(uri)
    if is_local(filesystem):
        return Path(path)
    try:
        if not filesystem.exists(path):
            raise FileError(uri, "nothing is there; check the address")
        size = sum(filesystem.du(path, total=False).values())
        if size > most_bytes:
            most = f"{most_bytes / 1e9:.3g} (--fetch-gb)"
            raise FileError(uri, f"{size / 1e9:.3g} GB, expected up to {most}")
        folder.mkdir(exist_ok=True)
        target = folder / (path.rstrip("/").rsplit("/", 1)[-1] or "recording")
        if filesystem.isdir(path):
            filesystem.get(path.rstrip("/") + "/", f"{target}/", recursive=True)
        else:
            filesystem.get_file(path, str(target))
    except CalibrationError:
        raise
    except Exception as error:  # of any store's client
        raise OSError(f"{uri}: cannot be fetched ({error})") from error
    return target


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

    Raises:
        FileError: if nothing is there, unless it may be new, or it cannot be read.
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
