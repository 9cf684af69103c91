"""The tracker's knowledge as bytes and back, bit by bit: a tree in JSON, then its arrays.

    8 bytes: length of the JSON | JSON: {"rig", "tree", "arrays"} | the arrays, one after the other

Dataclasses are written by name and read from the list below alone: nothing in a file can name
code to run.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.tracking.epoch_summary import Memory
from calibgraph.tracking.repetition import Groups
from calibgraph.tracking.spread import Spread
from calibgraph.tracking.state import (
    CameraState,
    DriftWatch,
    Epoch,
    LiveFrame,
    State,
    Suspect,
)
from factors import Lens, ProjectionBlock

_KINDS: dict[str, type] = {
    kind.__name__: kind
    for kind in (State, CameraState, DriftWatch, Epoch, LiveFrame, Suspect, Groups, Memory, Spread,
                 ResidualScale, Correspondences, CameraBlock, ProjectionBlock)
}  # fmt: skip
_DTYPES = ("<f8", "<f4", "<i8", "<i4", "|b1")
_LENGTH = struct.Struct("<Q")


class UnreadableError(CalibrationError):
    """Bytes that are not what :func:`packed` writes."""


def packed(content: Any, rig: Rig) -> bytes:
    """Bytes of a tree of tuples, mappings, plain values, arrays and the tracker's dataclasses.

    Args:
        content: the tree.
        rig: whose lenses it refers to.
    """
    writer = _Writer([camera.lens for camera in rig.cameras.values()])
    described = {
        "rig": rig.model_dump(mode="json"),
        "tree": writer.plain(content),
        "transforms": [writer.plain(T) for T in _transforms(rig)],
        "arrays": writer.described,
    }
    text = json.dumps(described).encode()
    return b"".join([_LENGTH.pack(len(text)), text, *writer.parts])


def unpacked(data: bytes) -> Any:
    """The tree that :func:`packed` has written.

    Raises:
        UnreadableError: if the bytes are not whole.
    """
    try:
        return _unpacked(data)
    except (ValueError, KeyError, TypeError, IndexError, struct.error, AttributeError) as error:
        raise UnreadableError(f"is not a tracker's state ({error!r})") from error


def _unpacked(data: bytes) -> Any:
    (length,) = _LENGTH.unpack_from(data)
    described = json.loads(data[_LENGTH.size : _LENGTH.size + length])
    arrays = _arrays(data, _LENGTH.size + length, described["arrays"])
    rig = _with_transforms(
        Rig.model_validate(described["rig"]),
        [arrays[place["array"]] for place in described["transforms"]],
    )
    reader = _Reader(arrays, rig)
    return reader.value(described["tree"])


def _arrays(data: bytes, start: int, described: Sequence[Any]) -> list[NDArray[Any]]:
    arrays = []
    for dtype, shape in described:
        if dtype not in _DTYPES:
            raise ValueError(f"unknown type of number {dtype!r}")
        count = int(np.prod(shape, dtype=np.int64))
        array = np.frombuffer(data, dtype, count, start).reshape(shape).copy()
        start += array.nbytes
        arrays.append(array)
    return arrays


def _transforms(rig: Rig) -> list[NDArray[np.float64]]:
    """Every transform of a rig, whose last bits a check of the model would change."""
    return [
        *(camera.T_camera_lidar for camera in rig.cameras.values()),
        *(pair.T_a_b for pair in rig.relative_poses),
    ]


def _with_transforms(rig: Rig, transforms: Sequence[NDArray[np.float64]]) -> Rig:
    count = len(rig.cameras)
    cameras = {
        name: camera.model_copy(update={"T_camera_lidar": T})
        for (name, camera), T in zip(rig.cameras.items(), transforms[:count], strict=True)
    }
    pairs = tuple(
        pair.model_copy(update={"T_a_b": T})
        for pair, T in zip(rig.relative_poses, transforms[count:], strict=True)
    )
    return rig.model_copy(update={"cameras": cameras, "relative_poses": pairs})


class _Writer:
    """Turns values into what JSON has, and sets arrays aside."""

    def __init__(self, lenses: Sequence[Lens]) -> None:
        self._lenses = lenses
        self.parts: list[bytes] = []
        self.described: list[tuple[str, tuple[int, ...]]] = []

    def plain(self, value: Any) -> Any:
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
        if isinstance(value, np.ndarray):
            return self._array(value)
        if isinstance(value, (Rig, Config, Lens, gtsam.Pose3)):
            return self._leaf(value)
        return self._compound(value)

    def _leaf(self, value: Rig | Config | Lens | gtsam.Pose3) -> Any:
        if isinstance(value, Rig):
            return {"rig": True}
        if isinstance(value, Config):
            return {"config": value.model_dump(mode="json")}
        if isinstance(value, Lens):
            return {"lens": next(i for i, lens in enumerate(self._lenses) if lens is value)}
        return {"pose": self._array(value.matrix())["array"]}

    def _compound(self, value: Any) -> Any:
        if isinstance(value, (tuple, list)):
            return {"items": [self.plain(item) for item in value]}
        if isinstance(value, Mapping):
            return {"pairs": [[self.plain(k), self.plain(v)] for k, v in value.items()]}
        name = type(value).__name__
        if _KINDS.get(name) is not type(value) or not is_dataclass(value):
            raise TypeError(f"cannot write a {name}")
        own = {f.name: self.plain(getattr(value, f.name)) for f in fields(value) if f.init}
        return {"kind": name, "fields": own}

    def _array(self, array: NDArray[Any]) -> dict[str, int]:
        whole = np.ascontiguousarray(array)
        dtype = whole.dtype.newbyteorder("<").str
        if dtype not in _DTYPES:
            raise TypeError(f"cannot write an array of {dtype}")
        self.parts.append(whole.astype(dtype, copy=False).tobytes())
        self.described.append((dtype, array.shape))
        return {"array": len(self.parts) - 1}


class _Reader:
    """The way back."""

    def __init__(self, arrays: Sequence[NDArray[Any]], rig: Rig) -> None:
        self._arrays = arrays
        self._rig = rig
        self._lenses = [camera.lens for camera in rig.cameras.values()]

    def value(self, plain: Any) -> Any:
        if not isinstance(plain, dict):
            return plain
        (what, held), *more = plain.items()
        if what == "kind":
            kind = _KINDS[held]
            return kind(**{name: self.value(item) for name, item in more[0][1].items()})
        if what == "items":
            return tuple(self.value(item) for item in held)
        if what == "pairs":
            return {self.value(key): self.value(item) for key, item in held}
        return self._leaf(what, held)

    def _leaf(self, what: str, held: Any) -> Any:
        if what == "array":
            return self._arrays[held]
        if what == "pose":
            return gtsam.Pose3(self._arrays[held])
        if what == "lens":
            return self._lenses[held]
        if what == "rig":
            return self._rig
        if what == "config":
            return Config.model_validate(held)
        raise ValueError(f"unknown kind of value {what!r}")
