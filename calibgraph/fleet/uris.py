"""Addresses of files: local paths, or URIs of fsspec such as ``s3://bucket/drive``."""

import hashlib
import json
from pathlib import Path
from typing import Any

import pyarrow as pa

from calibgraph.errors import CalibrationError, FileError, needs_extra
from calibgraph.files import sha256

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
    """The local path of a URI; remote data of at most ``most_bytes`` are copied into a folder."""
    filesystem, path = locate(uri)
    if is_local(filesystem):
        return Path(path)
    if not filesystem.exists(path):
        raise FileError(uri, "nothing is there; check the address")
    size = sum(filesystem.du(path, total=False).values())
    if size > most_bytes:
        most = f"{most_bytes / 1e9:.3g} (--fetch-gb of fleet, --recording-gb of serve)"
        raise FileError(uri, f"{size / 1e9:.3g} GB, expected up to {most}")
    name = path.rstrip("/").rsplit("/", 1)[-1] or "recording"
    target = folder / name
    if filesystem.isdir(path):
        filesystem.get(path.rstrip("/") + "/", f"{target}/", recursive=True)
    else:
        filesystem.get_file(path, str(target))
    return target
