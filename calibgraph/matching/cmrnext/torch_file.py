"""Reads files that ``torch.save`` wrote, without running anything in them.

``torch.load(weights_only=True)`` builds nothing but plain data and tensors; no way around that is
known from torch 2.10 on (CVE-2025-32434, CVE-2026-24747). A file that claims more than it holds
could still exhaust memory: so sizes are checked before.
"""

from __future__ import annotations

import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

from calibgraph.errors import FileError, in_words

MAX_BYTES = 2 * 2**30

_ADVICE = "download it again, or save its config and state_dict anew where it was made"


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

    Objects of classes beyond plain data become inert.

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
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise ValueError("its entries are packed, which torch does not do")
    if sum(entry.file_size for entry in entries) > size:
        raise ValueError("its entries claim more bytes than the file has")
    foreign = torch.serialization.get_unsafe_globals_in_checkpoint(path)
    stand_ins: list[Any] = [(_STAND_INS.get(name, _Foreign), name) for name in foreign]
    with torch.serialization.safe_globals(stand_ins), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pickle protocols: what cannot be read is an error
        return torch.load(path, map_location="cpu", weights_only=True)
