"""Reads what ``torch.save`` wrote, without running any of it.

The file is a zip of one pickle and of raw tensors. A pickle is a program; this is an interpreter
of the few of its instructions that build plain data and tensors. Classes and functions that it
names are never looked up: a handful stand for plain data, every other becomes an inert mark.
"""

from __future__ import annotations

import math
import pickletools
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError

MAX_BYTES = 4 * 2**30
MAX_PICKLE_BYTES = 16 * 2**20
MAX_INSTRUCTIONS = 1_000_000  # a network with its optimizer's state has some 30,000
MAX_DIMENSIONS = 8

_MAX_INTEGER = 2**63
_MAX_NUMBER_BYTES = 16  # of one pickled numpy number
_DTYPES = {
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


@dataclass(frozen=True)
class _Name:
    """A class or function that the pickle names. It is not looked up."""

    module: str
    name: str


@dataclass(frozen=True)
class _NumberType:
    """A numpy number type."""

    dtype: np.dtype[Any]


class _Inert:
    """Stands for an object of which nothing is known; nothing can be done with it."""


class _Mark:
    """Where a run of items begins on the stack."""


_Value = Any
_MARK = _Mark()


def read_checkpoint(path: Path) -> dict[Any, Any]:
    """The mapping in a file that ``torch.save`` wrote; its tensors as read-only arrays.

    Raises:
        FileError: if it is not such a file, is damaged, or claims more than it holds.
    """
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise FileError(path, f"{size} bytes is too large for a checkpoint")
        with zipfile.ZipFile(path) as archive:
            content = _read(archive, size)
    except zipfile.BadZipFile:
        raise FileError(
            path,
            "is not a checkpoint of torch 1.6 or newer, or is damaged; download it again, or "
            "load it where it was made and torch.save it anew",
        ) from None
    except (ValueError, IndexError, EOFError, RuntimeError, OSError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise FileError(path, f"cannot be read as a checkpoint: {reason}") from None
    if not isinstance(content, dict):
        raise FileError(path, "holds no mapping, expected a checkpoint's")
    return content


def _read(archive: zipfile.ZipFile, size: int) -> _Value:
    entries = archive.infolist()
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise ValueError("its entries are packed, which torch does not do")
    if sum(entry.file_size for entry in entries) > size:
        raise ValueError("its entries claim more bytes than the file has")
    names = [entry for entry in entries if entry.filename.endswith("/data.pkl")]
    if len(names) != 1 or names[0].file_size > MAX_PICKLE_BYTES:
        raise ValueError(f"it has {len(names)} entries data.pkl, or one that is too large")
    root = names[0].filename.removesuffix("data.pkl")
    given = {entry.filename for entry in entries}
    if f"{root}byteorder" in given and archive.read(f"{root}byteorder") != b"little":
        raise ValueError("its byte order is not little")

    def storage(key: str) -> bytes:
        if f"{root}data/{key}" not in given:
            raise ValueError(f"storage {key} is missing")
        return archive.read(f"{root}data/{key}")

    return _Interpreter(storage).run(archive.read(names[0]))


class _Interpreter:
    """Runs a pickle's instructions on plain data.

    Args:
        read_storage: gives the bytes of a tensor storage by its number.
    """

    def __init__(self, read_storage: Callable[[str], bytes]) -> None:
        self.read_storage = read_storage
        self.storages: dict[str, NDArray[Any]] = {}
        self.stack: list[_Value] = []
        self.memo: dict[int, _Value] = {}

    def run(self, text: bytes) -> _Value:
        """What the pickle builds.

        Raises:
            ValueError, IndexError: if it does anything but build plain data and tensors.
        """
        for count, (instruction, argument, _) in enumerate(pickletools.genops(text)):
            if count >= MAX_INSTRUCTIONS:
                raise ValueError(f"its pickle has over {MAX_INSTRUCTIONS} instructions")
            if instruction.name == "STOP":
                return self.stack.pop()
            self._step(instruction.name, argument)
        raise ValueError("its pickle has no end")

    def _step(self, name: str, argument: _Value) -> None:
        if name in _IGNORED:
            return
        if name in _CONSTANTS:
            self.stack.append(_CONSTANTS[name]())
        elif name in _LITERALS:
            if isinstance(argument, int) and not -_MAX_INTEGER <= argument < _MAX_INTEGER:
                raise ValueError("it holds a whole number beyond 64 bits")
            self.stack.append(argument)
        elif name in _MEMO_WRITES:
            self.memo[len(self.memo) if argument is None else argument] = self.stack[-1]
        elif name in _MEMO_READS:
            if argument not in self.memo:
                raise ValueError("it recalls what it has not stored")
            self.stack.append(self.memo[argument])
        elif name in _TUPLES:
            items = [self.stack.pop() for _ in range(_TUPLES[name])]
            self.stack.append(tuple(reversed(items)))
        elif name in _BUILDERS:
            _BUILDERS[name](self, argument)
        else:
            raise ValueError(f"its pickle has the instruction {name}, which plain data needs not")

    def _items(self) -> list[_Value]:
        """What lies above the last mark; both are taken off."""
        items = []
        while (item := self.stack.pop()) is not _MARK:
            items.append(item)
        return items[::-1]

    def _tuple(self, _: object) -> None:
        self.stack.append(tuple(self._items()))

    def _append(self, _: object) -> None:
        self._extend([self.stack.pop()])

    def _appends(self, _: object) -> None:
        self._extend(self._items())

    def _extend(self, items: list[_Value]) -> None:
        if isinstance(self.stack[-1], list):
            self.stack[-1].extend(items)

    def _setitem(self, _: object) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._update([key, value])

    def _setitems(self, _: object) -> None:
        self._update(self._items())

    def _update(self, items: list[_Value]) -> None:
        """Put keys and values, in turn, into the mapping on top of the stack."""
        if len(items) % 2:
            raise ValueError("a key without a value")
        if not isinstance(self.stack[-1], dict):
            return
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, (str, int)):
                raise ValueError("a key that is neither text nor a whole number")
            self.stack[-1][key] = value

    def _global(self, argument: str) -> None:
        self.stack.append(_Name(*argument.split(" ", 1)))

    def _stack_global(self, _: object) -> None:
        name, module = self.stack.pop(), self.stack.pop()
        if not isinstance(name, str) or not isinstance(module, str):
            raise ValueError("a class without a name")
        self.stack.append(_Name(module, name))

    def _new(self, _: object) -> None:
        del self.stack[-2:]
        self.stack.append(_Inert())

    def _build(self, _: object) -> None:
        """Objects have no state here: dropped."""
        self.stack.pop()

    def _reduce(self, _: object) -> None:
        arguments, function = self.stack.pop(), self.stack.pop()
        call = _CALLS.get((function.module, function.name)) if isinstance(function, _Name) else None
        if not isinstance(arguments, tuple):
            raise ValueError("a call without arguments")
        self.stack.append(_Inert() if call is None else call(*arguments[:_MAX_ARGUMENTS]))

    def _persistent(self, _: object) -> None:
        """A storage: ("storage", its type, its number, where it was, how many values)."""
        pid = self.stack.pop()
        if not isinstance(pid, tuple) or len(pid) != 5 or pid[0] != "storage":  # noqa: PLR2004
            raise ValueError("it refers to something that is no storage")
        _, kind, key, _, count = pid
        if not isinstance(kind, _Name) or kind.module != "torch" or kind.name not in _DTYPES:
            name = kind.name if isinstance(kind, _Name) else "no type"
            raise ValueError(f"it holds numbers of a type that is not supported ({name})")
        if not isinstance(key, str) or not re.fullmatch(r"\d{1,9}", key):
            raise ValueError("a storage without a number")
        if key not in self.storages:
            self.storages[key] = np.frombuffer(self.read_storage(key), _DTYPES[kind.name])
        array = self.storages[key]
        if array.dtype != _DTYPES[kind.name] or type(count) is not int or len(array) != count:
            raise ValueError(f"storage {key} holds something else than its entry says")
        self.stack.append(array)


def _tensor(
    storage: _Value,
    offset: _Value,
    size: _Value,
    stride: _Value,
    requires_grad: _Value = False,
    hooks: _Value = None,
    metadata: _Value = None,
) -> NDArray[Any]:
    """The view that a tensor is of its storage, after checking that it lies inside."""
    if not isinstance(storage, np.ndarray) or not isinstance(size, tuple) or metadata:
        raise ValueError("a tensor that is not plain")
    if not isinstance(stride, tuple) or len(size) != len(stride) or len(size) > MAX_DIMENSIONS:
        raise ValueError("a tensor without a shape")
    if not all(type(n) is int and 0 <= n <= len(storage) for n in (offset, *size, *stride)):
        raise ValueError(f"a tensor that claims more than its storage's {len(storage)} numbers")
    count = math.prod(size)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if count > len(storage) or (count and last >= len(storage)):
        raise ValueError(f"a tensor that claims more than its storage's {len(storage)} numbers")
    strides = [step * storage.itemsize for step in stride]
    start = storage[offset:] if count else storage[:0]
    return np.lib.stride_tricks.as_strided(start, size, strides, writeable=False)


def _parameter(array: _Value, *_: _Value) -> _Value:
    return array


def _ordered(*items: _Value) -> dict[Any, Any]:
    if items:
        raise ValueError("an ordered mapping that is not built item by item")
    return {}


def _number_type(name: _Value, *_: _Value) -> _NumberType:
    if not isinstance(name, str) or not re.fullmatch(r"[fiub][1248]", name):
        raise ValueError("a number of a type that is not supported")
    return _NumberType(np.dtype(name).newbyteorder("<"))


def _number(kind: _Value, data: _Value) -> float:
    if not isinstance(kind, _NumberType) or not isinstance(data, bytes):
        raise ValueError("a number without a type")
    if len(data) != kind.dtype.itemsize:
        raise ValueError("a number of the wrong length")
    value: float = np.frombuffer(data, kind.dtype)[0].item()
    return value


def _bytes(text: _Value, encoding: _Value = "latin1") -> bytes:
    if not isinstance(text, str) or encoding != "latin1" or len(text) > _MAX_NUMBER_BYTES:
        raise ValueError("bytes that are no number")
    return text.encode("latin1")


_MAX_ARGUMENTS = 7
_CALLS: dict[tuple[str, str], Callable[..., _Value]] = {
    ("collections", "OrderedDict"): _ordered,
    ("torch._utils", "_rebuild_tensor_v2"): _tensor,
    ("torch._utils", "_rebuild_parameter"): _parameter,
    ("numpy", "dtype"): _number_type,
    ("numpy.core.multiarray", "scalar"): _number,
    ("numpy._core.multiarray", "scalar"): _number,
    ("_codecs", "encode"): _bytes,
}
_IGNORED = frozenset({"PROTO", "FRAME"})
_CONSTANTS: dict[str, Callable[[], _Value]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_DICT": dict,
    "EMPTY_LIST": list,
    "EMPTY_TUPLE": tuple,
    "EMPTY_SET": _Inert,
    "MARK": lambda: _MARK,
}
_LITERALS = frozenset({
    "BININT", "BININT1", "BININT2", "LONG1", "LONG4", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE",
    "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8",
})  # fmt: skip
_MEMO_WRITES = frozenset({"BINPUT", "LONG_BINPUT", "MEMOIZE"})
_MEMO_READS = frozenset({"BINGET", "LONG_BINGET"})
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_BUILDERS: dict[str, Callable[[_Interpreter, _Value], None]] = {
    "TUPLE": _Interpreter._tuple,
    "APPEND": _Interpreter._append,
    "APPENDS": _Interpreter._appends,
    "ADDITEMS": _Interpreter._appends,
    "SETITEM": _Interpreter._setitem,
    "SETITEMS": _Interpreter._setitems,
    "GLOBAL": _Interpreter._global,
    "STACK_GLOBAL": _Interpreter._stack_global,
    "REDUCE": _Interpreter._reduce,
    "NEWOBJ": _Interpreter._new,
    "BUILD": _Interpreter._build,
    "BINPERSID": _Interpreter._persistent,
}
