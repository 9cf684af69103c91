"""Reads files that ``torch.save`` wrote, without running anything in them.

``torch.load(weights_only=True)`` builds nothing but plain data and tensors; no way around that is
known from torch 2.10 on (CVE-2025-32434, CVE-2026-24747). A hostile file can still exhaust memory
or time: so sizes and pickle instructions are checked before.
"""

from __future__ import annotations

import io
import mmap
import pickletools
import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from calibgraph.errors import FileError, in_words

MAX_BYTES = 2 * 2**30
MAX_ENTRIES = 100_000
MAX_PICKLE_BYTES = 16 * 2**20
MAX_INSTRUCTIONS = 1_000_000  # a network with its optimizer's state has some 30,000
MAX_TEXT = 10_000
MAX_TUPLE_PARTS = 1000  # over all levels: hashing visits each, as often as it is contained
MAX_FOREIGN_NAMES = 100

_STORAGES = ("Float", "Double", "Half", "BFloat16", "Long", "Int", "Short", "Char", "Byte", "Bool")
_PLAIN_NAMES = frozenset({
    "collections.OrderedDict", "torch._utils._rebuild_tensor_v2", "torch._utils._rebuild_parameter",
    "torch.device", "torch.Size", "_codecs.encode", *(f"torch.{kind}Storage" for kind in _STORAGES),
})  # fmt: skip
_ADVICE = "download it again, or save its config and state_dict anew where it was made"
_DIRECTORY_ENTRY = b"PK\x01\x02"
_GETS = frozenset({"BINGET", "LONG_BINGET"})
_PUTS = frozenset({"BINPUT", "LONG_BINPUT"})
_CALLS = frozenset({"REDUCE", "NEWOBJ"})

_Item = int | str | None
"""On the stack: how many parts a value has; the name of a class or function; None, a mark."""


class _Foreign:
    """Stands for an object of any class but those of plain data; it has no content."""

    def __new__(cls, *_: object) -> _Foreign:
        return super().__new__(cls)

    def __setstate__(self, _: object) -> None:
        """Drop the state."""


class _NumberType:
    """Stands for numpy's number types."""

    def __init__(self, name: object, *_: object) -> None:
        if not isinstance(name, str) or not re.fullmatch(r"[fiub][1248]", name):
            raise ValueError("a numpy number of an unknown type")
        self.dtype = np.dtype(name).newbyteorder("<")

    def __setstate__(self, _: object) -> None:
        """Drop the state: the byte order is little."""


def _to_number(kind: _NumberType, data: bytes) -> float:
    """A numpy number as a plain one."""
    value: float = np.frombuffer(data, kind.dtype, count=1)[0].item()
    return value


_STAND_INS: dict[str, Any] = {
    "numpy.dtype": _NumberType,
    "numpy.core.multiarray.scalar": _to_number,
    "numpy._core.multiarray.scalar": _to_number,
}


def read_torch_file(path: Path) -> dict[Any, Any]:
    """Read the mapping that ``torch.save`` wrote; its tensors are on the CPU.

    Objects of classes beyond plain data become inert. At most three times the file's size is held
    in memory.

    Raises:
        FileError: if it is not such a file, is damaged, too large, or claims more than it holds.
    """
    try:
        content = _load(path)
    except zipfile.BadZipFile:
        raise FileError(
            path, f"is not a checkpoint of torch 1.6 or newer, or is damaged; {_ADVICE}"
        ) from None
    except Exception as error:  # torch raises anything on damaged files
        raise FileError(
            path, f"cannot be read as a checkpoint: {_reason(error)}; {_ADVICE}"
        ) from None
    if not isinstance(content, dict):
        raise FileError(path, "holds no mapping, expected a checkpoint's")
    return content


def _reason(error: Exception) -> str:
    """The cause alone: torch surrounds it with advice to load the file unsafely."""
    text = in_words(error)
    cause = re.search(r"(?:WeightsUnpickler error:|\n\n)\s*(?!\n)(\S[^\n]*)", text)
    return (cause[1] if cause else text.splitlines()[0]).rstrip(". ")


def _load(path: Path) -> object:
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{size} bytes, expected at most {MAX_BYTES}")
    with path.open("rb") as file:
        if size and _count_entries(file.fileno()) > MAX_ENTRIES:
            raise ValueError(f"over {MAX_ENTRIES} entries")
        with zipfile.ZipFile(file) as archive:
            checkpoint, program = _copy(archive, size)
    names = scan_pickle(program)
    foreign = set(torch.serialization.get_unsafe_globals_in_checkpoint(checkpoint))
    if unknown := names - _PLAIN_NAMES - foreign:
        raise ValueError(f"its pickle uses {min(unknown)}, which weights do not need")
    if len(foreign) > MAX_FOREIGN_NAMES:
        raise ValueError(f"its pickle names {len(foreign)} classes beyond plain data")
    checkpoint.seek(0)
    stand_ins: list[Any] = [(_STAND_INS.get(name, _Foreign), name) for name in foreign]
    with torch.serialization.safe_globals(stand_ins), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pickle protocols: what cannot be read is an error
        return torch.load(checkpoint, map_location="cpu", weights_only=True)


def _count_entries(descriptor: int) -> int:
    """An upper bound of the entries in a zip file's directory."""
    with mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ) as data:
        count, at = 0, data.find(_DIRECTORY_ENTRY)
        while at >= 0 and count <= MAX_ENTRIES:
            count, at = count + 1, data.find(_DIRECTORY_ENTRY, at + 1)
    return count


def _copy(archive: zipfile.ZipFile, size: int) -> tuple[io.BytesIO, bytes]:
    """The records of a checkpoint in a new archive, and its pickle.

    Torch's own reader may see other entries in a hostile archive than those checked here.
    """
    entries = archive.infolist()
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise ValueError("its entries are packed, which torch does not do")
    if sum(entry.file_size for entry in entries) > size:
        raise ValueError("its entries claim more bytes than the file has")
    pickles = [entry for entry in entries if entry.filename.endswith("/data.pkl")]
    if len(pickles) != 1 or pickles[0].file_size > MAX_PICKLE_BYTES:
        raise ValueError(f"it has {len(pickles)} entries data.pkl, or one that is too large")
    root = pickles[0].filename.removesuffix("data.pkl")
    copy = io.BytesIO()
    with zipfile.ZipFile(copy, "w") as target:
        for entry in entries:
            name = entry.filename.removeprefix(root)
            if name in ("data.pkl", "version", "byteorder") or name.startswith("data/"):
                target.writestr(f"checkpoint/{name}", archive.read(entry))
    copy.seek(0)
    return copy, archive.read(pickles[0])


def scan_pickle(program: bytes) -> set[str]:
    """Check a pickle without running it.

    Args:
        program: the pickle.

    Returns:
        Dotted names of all classes and functions that it names.

    Raises:
        ValueError, LookupError: if it is malformed, or if building what it describes could take
            more time or memory than its size suggests.
    """
    stack: list[_Item] = []
    memo: dict[int, _Item] = {}
    names: set[str] = set()
    argument: Any
    for count, (instruction, argument, _) in enumerate(pickletools.genops(program)):
        if count >= MAX_INSTRUCTIONS:
            raise ValueError(f"its pickle has over {MAX_INSTRUCTIONS} instructions")
        if isinstance(argument, (str, bytes)) and len(argument) > MAX_TEXT:
            raise ValueError(f"its pickle has a text of over {MAX_TEXT} characters")
        if instruction.name in _GETS:
            stack.append(memo[argument])
        elif instruction.name in _PUTS:
            memo[argument] = stack[-1]
        elif instruction.name == "MARK":
            stack.append(None)
        elif instruction.name == "GLOBAL":
            stack.append(argument.replace(" ", ".", 1))
            names.add(argument.replace(" ", ".", 1))
        else:
            stack += _results(instruction, _take(stack, instruction))
    return names


def _take(stack: list[_Item], instruction: pickletools.OpcodeInfo) -> list[int | str]:
    """Take an instruction's operands off the stack, the last first."""
    operands, taken = instruction.stack_before, []
    if pickletools.stackslice in operands:
        while (item := stack.pop()) is not None:
            taken.append(item)
        operands = operands[: operands.index(pickletools.markobject)]
    for _ in operands:
        item = stack.pop()
        if item is None:
            raise ValueError("its pickle has a mark in place of a value")
        taken.append(item)
    return taken


def _results(instruction: pickletools.OpcodeInfo, operands: list[int | str]) -> list[int]:
    """What an instruction leaves on the stack."""
    parts = 1
    if instruction.name in _CALLS and not isinstance(operands[1], str):
        raise ValueError("its pickle calls a value that is no function")
    if instruction.name.startswith("TUPLE"):  # the only value with parts that can be hashed
        parts += sum(item if isinstance(item, int) else 1 for item in operands)
    if parts > MAX_TUPLE_PARTS:
        raise ValueError(f"its pickle has a tuple of over {MAX_TUPLE_PARTS} parts")
    return [parts] * len(instruction.stack_after)
