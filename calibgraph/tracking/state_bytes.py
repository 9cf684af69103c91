"""What a tracker keeps as bytes and back, bit by bit: MessagePack behind a format and a checksum.

A dataclass is written as its fields and read from a fixed list: no content of a file can name code
to run.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

import msgpack
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError, in_words
from calibgraph.graph.components import VarianceRatios
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.rig import Rig
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.robust import ResidualScale
from calibgraph.tracking.events import Event, Size
from calibgraph.tracking.frames import StreamFrame
from calibgraph.tracking.gate import Gated
from calibgraph.tracking.state import DriftWatch, State
from calibgraph.tracking.sums import PlaceSums, Sums
from factors import Lens, ProjectionBlock

Kind = TypeVar("Kind")

_MARK = b"calibgraph-tracker/19\n"
_BODY = len(_MARK) + hashlib.sha256().digest_size
_DTYPES = ("<f8", "<f4", "<i8", "<i4", "|b1")


class StateError(CalibrationError):
    """Bytes that :func:`encode` has not written, or that are damaged."""


def encode(content: object) -> bytes:
    """Bytes of a tree of tuples, dicts, plain values, arrays and the tracker's dataclasses.

    Raises:
        TypeError: if the tree holds any other value, or a number of more than 64 bits.
    """
    body = _pack(content)
    return _MARK + hashlib.sha256(body).digest() + body


def decode(data: bytes, kind: type[Kind]) -> Kind:
    """The tree of some kind that :func:`encode` has written.

    Raises:
        StateError: if the bytes are damaged, of another version or of another kind.
    """
    if not data.startswith(_MARK):
        begin = data[: len(_MARK)].partition(b"\n")[0].decode("ascii", "replace")
        expected = _MARK.decode().strip()
        raise StateError(f"is of another version: it begins with {begin!r}, expected {expected!r}")
    body = data[_BODY:]
    if hashlib.sha256(body).digest() != data[len(_MARK) : _BODY]:
        raise StateError("is damaged: its checksum is wrong")
    try:
        content = _unpack(body)
    except Exception as error:  # of any kind: the bytes choose what is built, and of what
        raise StateError(f"is no tracker's state ({in_words(error)})") from error
    if not isinstance(content, kind):
        raise StateError(f"is no tracker's {kind.__name__.lower()}")
    return content


def _pack(value: object) -> bytes:
    def extension(value: Any) -> msgpack.ExtType:
        if (code := _CODES.get(type(value))) is None:
            raise TypeError(f"cannot write a {type(value).__name__}")
        return msgpack.ExtType(code, _pack(_KINDS[code][1](value)))

    packed: bytes = msgpack.packb(value, default=extension)
    return packed


def _unpack(data: bytes) -> Any:
    return msgpack.unpackb(
        data, ext_hook=lambda code, held: _KINDS[code][2](_unpack(held)), use_list=False,
        strict_map_key=False,
    )  # fmt: skip


def _array(value: NDArray[Any]) -> tuple[str, tuple[int, ...], bytes]:
    dtype = value.dtype.newbyteorder("<").str
    if dtype not in _DTYPES:
        raise TypeError(f"cannot write an array of {dtype}")
    return dtype, value.shape, value.astype(dtype, copy=False).tobytes()


def _to_array(held: tuple[str, tuple[int, ...], bytes]) -> NDArray[Any]:
    dtype, shape, data = held
    kind = _DTYPES[_DTYPES.index(dtype)]
    return np.frombuffer(data, kind, math.prod(shape)).reshape(shape).copy()


def _fields_of(kind: type) -> Callable[[Any], dict[str, Any]]:
    names = tuple(one.name for one in fields(kind) if one.init)
    return lambda value: {name: getattr(value, name) for name in names}


_KINDS: tuple[tuple[type, Callable[[Any], Any], Callable[[Any], Any]], ...] = (
    (np.ndarray, _array, _to_array),
    *((kind, lambda model: model.model_dump(mode="json"), kind.model_validate)
      for kind in (Rig, Config)),
    *((kind, _fields_of(kind), lambda held, kind=kind: kind(**held))
      for kind in (State, DriftWatch, Gated, Sums, PlaceSums, MatcherFindings,
                   VarianceRatios, ResidualScale, Correspondences, CameraBlock, ProjectionBlock,
                   Lens, Event, Size, StreamFrame)),
)  # fmt: skip
_CODES = {kind: code for code, (kind, _, _) in enumerate(_KINDS)}
