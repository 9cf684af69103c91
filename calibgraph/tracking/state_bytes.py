"""The tracker's state as bytes and back, bit by bit: an npz archive without pickle.

The archive holds ``json``, the tree of values as JSON text, and one flat array per type of number.
In the tree an array is ``{"array": [dtype, offset, shape]}``. A dataclass is written by its name
and read from a fixed list: no content of a file can name code to run.

A saved tracker is a file of its own: the line ``calibgraph-tracker-file/1``, the SHA-256 of the
archive, the archive.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError, FileError, in_words
from calibgraph.files import require_file, write_bytes
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.rig import Rig
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.solver.scan_distortion import DistortionEvidence
from calibgraph.solver.variance_components import VarianceRatios
from calibgraph.tracking.epoch_summary import EpochSummary
from calibgraph.tracking.live_frames import Epoch, LiveFrame, OutlierFrame
from calibgraph.tracking.noise import GroupScatter, ResidualHistogram
from calibgraph.tracking.optimum import Optimum
from calibgraph.tracking.place_sums import PlaceSums
from calibgraph.tracking.state import CameraState, DriftWatch, State
from calibgraph.tracking.sums import Sums
from factors import Lens, ProjectionBlock

FORMAT = "calibgraph-tracker-state/7"
"""Of the archive; earlier ones held other sums."""

_FILE_MARK = b"calibgraph-tracker-file/1\n"
_DIGEST_BYTES = hashlib.sha256().digest_size

_DATACLASSES: dict[str, type] = {
    kind.__name__: kind
    for kind in (State, CameraState, DriftWatch, Epoch, LiveFrame, OutlierFrame, GroupScatter,
                 EpochSummary, Sums, PlaceSums, Optimum, DistortionEvidence, MatcherFindings,
                 VarianceRatios, ResidualHistogram, ResidualScale, Correspondences, CameraBlock,
                 ProjectionBlock)
}  # fmt: skip
_DECODING_ERRORS = (
    ValueError, LookupError, TypeError, AttributeError, OSError, MemoryError, EOFError,
    NotImplementedError, RecursionError, TokenError, zipfile.BadZipFile,
)  # fmt: skip
"""What JSON, zipfile, numpy and the constructors of values raise on damaged bytes."""
_DTYPES = ("<f8", "<f4", "<i8", "<i4", "|b1")


class StateError(CalibrationError):
    """Bytes that :func:`encode` has not written, or that are damaged."""


def encode(content: Any, rig: Rig) -> bytes:
    """Bytes of a tree of tuples, mappings, plain values, arrays and the tracker's dataclasses.

    Args:
        content: the tree.
        rig: the rig whose lenses the tree refers to.

    Raises:
        TypeError: if the tree holds any other value.
    """
    encoder = _Encoder([camera.lens for camera in rig.cameras.values()])
    described = {
        "format": FORMAT,
        "rig": rig.model_dump(mode="json"),
        "tree": encoder.to_plain(content),
        "transforms": [encoder.to_plain(T) for T in _transforms(rig)],
    }
    text = np.frombuffer(json.dumps(described).encode(), np.uint8)
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, json=text, **encoder.flat_arrays())
    return archive.getvalue()


def decode(data: bytes) -> Any:
    """The tree that :func:`encode` has written.

    Raises:
        StateError: if the bytes are damaged or of another format.
    """
    try:
        return _decode(data)
    except StateError:
        raise
    except _DECODING_ERRORS as error:
        raise StateError(f"is not a tracker's state ({in_words(error)})") from error


def save_state_file(path: Path, state: bytes) -> None:
    """Write encoded state to a file of its own, atomically."""
    write_bytes(path, _FILE_MARK + hashlib.sha256(state).digest() + state)


def load_state_file(path: Path) -> bytes:
    """The encoded state in a file of :func:`save_state_file`.

    Raises:
        FileError: if the file is missing, damaged or of another format.
    """
    data = require_file(path).read_bytes()
    start = len(_FILE_MARK) + _DIGEST_BYTES
    expected = _FILE_MARK.decode().strip()
    if not data.startswith(_FILE_MARK):
        raise FileError(path, f"is not a {expected} file; track anew from a rig")
    if hashlib.sha256(data[start:]).digest() != data[len(_FILE_MARK) : start]:
        raise FileError(path, "is damaged: its checksum is wrong; use another copy")
    return data[start:]


def _decode(data: bytes) -> Any:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if sum(member.file_size for member in archive.infolist()) > len(data):
            raise StateError("is not a tracker's state (it is compressed)")
    with np.load(io.BytesIO(data), allow_pickle=False) as members:
        described = json.loads(members["json"].tobytes())
        flat = {dtype: members[dtype] for dtype in _DTYPES if dtype in members}
    if described["format"] != FORMAT:
        raise StateError(f"is of format {described['format']!r}, expected {FORMAT!r}")
    rig = Rig.model_validate(described["rig"])
    decoder = _Decoder(flat, rig)
    transforms = [decoder.to_value(T) for T in described["transforms"]]
    return _Decoder(flat, _with_transforms(rig, transforms)).to_value(described["tree"])


def _transforms(rig: Rig) -> list[NDArray[np.float64]]:
    """Every transform of a rig: validation of the rig's model would change their last bits."""
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


class _Encoder:
    """Turns values into what JSON has; arrays are collected by their type of number."""

    def __init__(self, lenses: Sequence[Lens]) -> None:
        self._lenses = lenses
        self._parts: dict[str, list[NDArray[Any]]] = {}
        self._sizes: dict[str, int] = {}

    def flat_arrays(self) -> dict[str, NDArray[Any]]:
        """All arrays of a type of number end to end, by the type's name."""
        return {dtype: np.concatenate(parts) for dtype, parts in self._parts.items()}

    def to_plain(self, value: Any) -> Any:
        """A value as JSON."""
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
        return {"transform": self._array(value.matrix())}

    def _compound(self, value: Any) -> Any:
        if isinstance(value, (tuple, list)):
            return {"items": [self.to_plain(item) for item in value]}
        if isinstance(value, Mapping):
            return {"pairs": [[self.to_plain(k), self.to_plain(v)] for k, v in value.items()]}
        name = type(value).__name__
        if _DATACLASSES.get(name) is not type(value) or not is_dataclass(value):
            raise TypeError(f"cannot write a {name}")
        own = {f.name: self.to_plain(getattr(value, f.name)) for f in fields(value) if f.init}
        return {"dataclass": name, "fields": own}

    def _array(self, array: NDArray[Any]) -> dict[str, Any]:
        dtype = array.dtype.newbyteorder("<").str
        if dtype not in _DTYPES:
            raise TypeError(f"cannot write an array of {dtype}")
        offset = self._sizes.get(dtype, 0)
        self._parts.setdefault(dtype, []).append(array.astype(dtype, copy=False).ravel())
        self._sizes[dtype] = offset + array.size
        return {"array": [dtype, offset, array.shape]}


class _Decoder:
    """Turns JSON and flat arrays into values."""

    def __init__(self, flat: Mapping[str, NDArray[Any]], rig: Rig) -> None:
        self._flat = flat
        self._rig = rig
        self._lenses = [camera.lens for camera in rig.cameras.values()]

    def to_value(self, plain: Any) -> Any:
        """The value of a piece of JSON."""
        if not isinstance(plain, dict):
            return plain
        (what, held), *more = plain.items()
        if what == "dataclass":
            own = {name: self.to_value(item) for name, item in more[0][1].items()}
            return _DATACLASSES[held](**own)
        if what == "items":
            return tuple(self.to_value(item) for item in held)
        if what == "pairs":
            return {self.to_value(key): self.to_value(item) for key, item in held}
        return self._leaf(what, held)

    def _leaf(self, what: str, held: Any) -> Any:
        if what == "array":
            dtype, offset, shape = held
            size = int(np.prod(shape, dtype=np.int64))
            return self._flat[dtype][offset : offset + size].reshape(shape).copy()
        if what == "transform":
            return gtsam.Pose3(self.to_value(held))
        if what == "lens":
            return self._lenses[held]
        if what == "rig":
            return self._rig
        if what == "config":
            return Config.model_validate(held)
        raise ValueError(f"unknown kind of value {what!r}")
