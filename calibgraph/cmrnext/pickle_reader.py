"""Reads what ``torch.save`` wrote, without running any of it.

The file is a zip of one pickle and of raw tensors. The pickle may name classes to build and
functions to call; here every name but a few that stand for plain data becomes an inert object.
"""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError

MAX_BYTES = 4 * 2**30
MAX_PICKLE_BYTES = 64 * 2**20
MAX_TENSOR_DIMENSIONS = 8

_STORAGE_TYPES = {
    "FloatStorage": "<f4",
    "DoubleStorage": "<f8",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
_MALFORMED = (
    pickle.UnpicklingError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    EOFError,
    AttributeError,
    AssertionError,
    OverflowError,
    MemoryError,
    RecursionError,
    UnicodeError,
)


class Inert(dict[Any, Any]):
    """Stands for an object of a class that is not known: it takes everything and does nothing."""

    def __init__(self, *_: object, **__: object) -> None:
        super().__init__()

    def __setstate__(self, state: object) -> None:
        """Ignore the state."""

    def append(self, item: object) -> None:
        """Ignore the item."""

    def extend(self, items: object) -> None:
        """Ignore the items."""


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The mapping in a file that ``torch.save`` wrote; its tensors as arrays, views of the file.

    Raises:
        FileError: if it is not such a file, is damaged, or claims more than it holds.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise FileError(path, f"{size} bytes is too large for a checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            content = _read(archive, size)
    except zipfile.BadZipFile:
        raise FileError(
            path,
            "is not a checkpoint of torch 1.6 or newer, or is truncated; download it again, or "
            "load it where it was made and torch.save it anew",
        ) from None
    except _MALFORMED as error:
        text = " ".join(str(error).split())[:200] or type(error).__name__
        raise FileError(path, f"cannot be read as a checkpoint: {text}") from None
    if not isinstance(content, dict) or isinstance(content, Inert):
        raise FileError(path, f"holds a {type(content).__name__}, expected a checkpoint's mapping")
    return content


def _read(archive: zipfile.ZipFile, size: int) -> Any:
    entries = {entry.filename: entry for entry in archive.infolist()}
    for entry in entries.values():
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > size:
            raise ValueError(f"{entry.filename!r} claims {entry.file_size} bytes, packed")
    names = [name for name in entries if name.endswith("/data.pkl")]
    if len(names) != 1:
        raise ValueError(f"it has {len(names)} entries data.pkl, expected 1")
    root = names[0].removesuffix("data.pkl")
    if entries[names[0]].file_size > MAX_PICKLE_BYTES:
        raise ValueError(f"its pickle has {entries[names[0]].file_size} bytes")
    if f"{root}byteorder" in entries and archive.read(f"{root}byteorder") != b"little":
        raise ValueError("its byte order is not little")
    text = archive.read(names[0])
    return _Unpickler(text, lambda key: archive.read(f"{root}data/{key}")).load()


class _Unpickler(pickle._Unpickler):  # the one in Python: its memo cannot be made huge
    """Builds plain data, arrays, and inert objects."""

    def __init__(self, text: bytes, read_storage: Callable[[str], bytes]) -> None:
        super().__init__(io.BytesIO(text))
        self.read_storage = read_storage
        self.storages: dict[str, bytes] = {}

    def find_class(self, module: str, name: str) -> Any:
        """The stand-in of a class or function."""
        if module == "torch" and name in _STORAGE_TYPES:
            return _STORAGE_TYPES[name]
        return _KNOWN.get((module, name), Inert)

    def persistent_load(self, pid: Any) -> NDArray[Any]:
        """A storage: ("storage", its type, its key, where it was, how many numbers)."""
        kind, dtype, key, _, count = pid
        if kind != "storage" or not isinstance(dtype, str) or not re.fullmatch(r"\d+", str(key)):
            raise ValueError(f"it refers to {pid!r}"[:100])
        if key not in self.storages:
            self.storages[key] = self.read_storage(str(key))
        array = np.frombuffer(self.storages[key], dtype=dtype)
        if len(array) != count:
            raise ValueError(f"storage {key} has {len(array)} numbers, its entry says {count}")
        return array


def _rebuild_tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: object) -> NDArray[Any]:
    """The view that a tensor is of its storage, after checking that it lies inside."""
    numbers = [offset, *size, *stride]
    if not isinstance(storage, np.ndarray) or len(size) != len(stride):
        raise ValueError("a tensor without a storage")
    if len(size) > MAX_TENSOR_DIMENSIONS or not all(type(n) is int and n >= 0 for n in numbers):
        raise ValueError(f"a tensor of size {tuple(size)}")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    count = int(np.prod(np.array(size, dtype=object), initial=1))
    if count and (last >= len(storage) or count > len(storage)):
        raise ValueError(f"a tensor of size {tuple(size)} in a storage of {len(storage)} numbers")
    strides = [step * storage.itemsize for step in stride]
    start = storage[offset:] if count else storage[:0]
    return np.lib.stride_tricks.as_strided(start, shape=size, strides=strides, writeable=False)


def _rebuild_parameter(array: Any, *_: object) -> Any:
    return array


def _dtype(name: Any, *_: object) -> _Dtype:
    if not isinstance(name, str) or not re.fullmatch(r"[fiub][1248]", name):
        raise ValueError(f"a number of type {name!r}")
    return _Dtype(name)


class _Dtype:
    """A numpy number type, whose pickled state adds nothing."""

    def __init__(self, name: str) -> None:
        self.dtype = np.dtype(name)

    def __setstate__(self, state: object) -> None:
        """Ignore byte order and alignment: files are little-endian."""


def _scalar(dtype: Any, data: Any) -> float:
    if not isinstance(dtype, _Dtype) or not isinstance(data, bytes):
        raise ValueError("a number without a type")
    value: float = np.frombuffer(data, dtype=dtype.dtype)[0].item()
    return value


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    if not isinstance(text, str) or encoding != "latin1":
        raise ValueError(f"bytes encoded as {encoding!r}")
    return text.encode("latin1")


_KNOWN: dict[tuple[str, str], Any] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
    ("numpy", "dtype"): _dtype,
    ("numpy.core.multiarray", "scalar"): _scalar,
    ("numpy._core.multiarray", "scalar"): _scalar,
    ("_codecs", "encode"): _encode,
}
