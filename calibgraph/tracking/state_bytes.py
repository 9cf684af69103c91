"""What a tracker keeps as bytes and back, bit by bit: MessagePack behind a format and a checksum.

A dataclass is written as its fields and read from a fixed list: no content of a file can name code
to run.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import fields
from itertools import takewhile
from typing import Annotated, Any, Literal

import msgpack
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, InstanceOf, TypeAdapter, ValidationError

from calibgraph.errors import CalibrationError, in_words
from calibgraph.files import describe
from calibgraph.graph.components import VarianceRatios
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.rig import Rig
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.robust import ResidualScale
from calibgraph.tracking.events import Event, Size
from calibgraph.tracking.state import DriftWatch, OutlierFrame, Spread, State
from calibgraph.tracking.sums import PlaceSums, Sums
from factors import Lens, ProjectionBlock

Kind = Literal["state", "input"]

_VERSION = 13
"""Earlier ones held other sums, or were of another encoding."""

_DIGEST = hashlib.sha256().digest_size
_TREES: dict[Kind, TypeAdapter[Any]] = {
    "state": TypeAdapter(InstanceOf[State]),
    "input": TypeAdapter(
        Annotated[tuple[tuple[int | None, InstanceOf[Correspondences]], ...], Field(min_length=1)]
    ),
}
_DTYPES = ("<f8", "<f4", "<i8", "<i4", "|b1")


class StateError(CalibrationError):
    """Bytes that :func:`encode` has not written, or that are damaged."""


def encode(content: Any, kind: Kind) -> bytes:
    """Bytes of a tree of tuples, dicts, plain values, arrays and the tracker's dataclasses.

    Args:
        content: the tree.
        kind: of which it is; :func:`decode` takes no other.

    Raises:
        TypeError: if the tree holds any other value, or a number of more than 64 bits.
        ValueError: if it is too deep.
    """
    body = _pack(content)
    return _mark(kind) + hashlib.sha256(body).digest() + body


def decode(data: bytes, kind: Kind) -> Any:
    """The tree that :func:`encode` has written: of a state or an input.

    Raises:
        StateError: if the bytes are damaged, of another format or of another kind.
    """
    mark = _mark(kind)
    if not data.startswith(mark):
        found = data[: len(mark)].decode("ascii", "replace")
        text = "".join(takewhile(str.isprintable, found.partition("\ufffd")[0]))
        expected = f"expected {mark[:-1].decode()!r}"
        raise StateError(f"is no tracker's {kind}: it begins with {text!r}, {expected}")
    start = len(mark) + _DIGEST
    digest, body = data[len(mark) : start], data[start:]
    if hashlib.sha256(body).digest() != digest:
        raise StateError("is damaged: its checksum is wrong")
    try:
        return _TREES[kind].validate_python(_unpack(body), strict=True)
    except ValidationError as error:
        raise StateError(f"is no tracker's {kind} ({describe(error)})") from error
    except Exception as error:  # of any kind: the bytes choose what is built, and of what
        raise StateError(f"is no tracker's {kind} ({in_words(error)})") from error


def _mark(kind: Kind) -> bytes:
    return f"calibgraph-tracker-{kind}/{_VERSION}\n".encode()


def _pack(value: Any) -> bytes:
    packed: bytes = msgpack.packb(value, default=_extension)
    return packed


def _unpack(data: bytes) -> Any:
    return msgpack.unpackb(data, ext_hook=_from_extension, use_list=False, strict_map_key=False)


def _extension(value: Any) -> msgpack.ExtType:
    code = _CODES.get(type(value))
    if code is None:
        raise TypeError(f"cannot write a {type(value).__name__}")
    return msgpack.ExtType(code, _pack(_KINDS[code][1](value)))


def _from_extension(code: int, data: bytes) -> Any:
    return _KINDS[code][2](_unpack(data))


def _array(value: NDArray[Any]) -> tuple[str, tuple[int, ...], bytes]:
    dtype = value.dtype.newbyteorder("<").str
    if dtype not in _DTYPES:
        raise TypeError(f"cannot write an array of {dtype}")
    return dtype, value.shape, value.astype(dtype, copy=False).tobytes()


def _to_array(held: tuple[str, tuple[int, ...], bytes]) -> NDArray[Any]:
    dtype, shape, data = held
    return (
        np.frombuffer(data, _DTYPES[_DTYPES.index(dtype)], math.prod(shape)).reshape(shape).copy()
    )


def _fields_of(kind: type) -> Callable[[Any], dict[str, Any]]:
    names = tuple(one.name for one in fields(kind) if one.init)
    return lambda value: {name: getattr(value, name) for name in names}


_KINDS: tuple[tuple[type, Callable[[Any], Any], Callable[[Any], Any]], ...] = (
    (np.ndarray, _array, _to_array),
    *((kind, lambda model: model.model_dump(mode="json"), kind.model_validate)
      for kind in (Rig, Config)),
    *((kind, _fields_of(kind), lambda held, kind=kind: kind(**held))
      for kind in (State, DriftWatch, OutlierFrame, Spread, Sums, PlaceSums, MatcherFindings,
                   VarianceRatios, ResidualScale, Correspondences, CameraBlock, ProjectionBlock,
                   Lens, Event, Size)),
)  # fmt: skip
_CODES = {kind: code for code, (kind, _, _) in enumerate(_KINDS)}
