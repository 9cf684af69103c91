"""Checkpoints: a network's weights, checked against their config, with the file's hash."""

from __future__ import annotations

import math
import re
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import BaseModel, Field, StrictBool
from torch import Tensor

from calibgraph.errors import FileError, in_words
from calibgraph.files import checked_model, sha256
from calibgraph.matching.cmrnext.network import Architecture, CmrNext

DOWNLOAD = (
    "the published weights are at "
    "https://cmrnext.cs.uni-freiburg.de/downloads/cmrnext_calibration_weights.zip; they are not "
    "part of calibgraph: GPL-3.0 for academic use, for other use ask their authors"
)

_Number = Annotated[float, Field(strict=True, ge=0)]


class _Config(BaseModel):
    """The keys of a config that anything depends on."""

    max_depth: Annotated[_Number, Field(ge=1, le=10_000)]
    max_r: Annotated[_Number, Field(le=180)] | None = None
    max_t: Annotated[_Number, Field(le=1000)] | None = None
    use_reflectance: StrictBool
    fourier_levels: Annotated[int, Field(strict=True)] = -1
    context_encoder: Literal["lidar", "rgb"] = "rgb"
    uncertainty: Literal[False] = False
    al_contrario: Literal[False] = False
    normalize_images: StrictBool


_MAX_TEXT, _MAX_INTEGER = 200, 2**53


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A network's weights and the config of their training."""

    path: Path
    sha256: str
    architecture: Architecture
    config: dict[str, Any]
    state: dict[str, Tensor]

    @property
    def max_depth_m(self) -> float:
        """The divisor of depths."""
        return float(self.config["max_depth"])

    @property
    def range_deg_m(self) -> tuple[float, float] | None:
        """Largest perturbation per axis in training [deg, m]; None if the config lacks it."""
        rotation, translation = (self.config.get(key) for key in ("max_r", "max_t"))
        return (float(rotation), float(translation)) if rotation and translation else None

    def network(self, device: str | torch.device = "cpu") -> CmrNext:
        """The network with these weights, for evaluation."""
        model = CmrNext(self.architecture)
        model.load_state_dict(self.state)
        return model.to(device).eval()


def load_checkpoint(path: Path | str) -> Checkpoint:
    """Read weights as they are published, written by ``torch.save``.

    Nothing in the file is executed.

    Raises:
        FileError: if the file is missing, damaged or hostile, holds no CMRNext network, or if its
            config and weights disagree.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        raise FileError(path, "is not a file; expected weights, as iter1.tar")
    if not path.exists():
        raise FileError(path, f"no such file of weights; {DOWNLOAD}")
    return _to_checkpoint(path, *_read_torch(path))


def _to_checkpoint(
    path: Path, given: Mapping[Any, Any], tensors: Mapping[str, Tensor]
) -> Checkpoint:
    try:
        # The part that is plain, printable values of ordinary size.
        config = {key: value for key, value in given.items() if _is_plain(key) and _is_plain(value)}
        architecture = _architecture(checked_model(_Config, config, path), tensors)
        state = _copy_state(architecture, tensors)
    except ValueError as error:
        raise FileError(path, f"{error}") from None
    return Checkpoint(path, sha256(path), architecture, config, state)


def _architecture(config: _Config, tensors: Mapping[str, Tensor]) -> Architecture:
    """The network by its config, and its width by its first layer; all weights have to fit it."""
    first = tensors.get("fnet_img.conv1.weight")
    if first is None or first.ndim != 4:  # noqa: PLR2004 - a convolution
        raise ValueError("these are not the weights of a CMRNext network")
    return Architecture(
        fourier_levels=config.fourier_levels,
        reflectance=config.use_reflectance,
        context=config.context_encoder,
        width=len(first),
    )


def _read_torch(path: Path) -> tuple[dict[Any, Any], dict[str, Tensor]]:
    content = read_torch_file(path)
    for key in ("config", "state_dict"):
        if not isinstance(content.get(key), dict):
            raise FileError(path, f"lacks {key!r}: expected the checkpoint of a CMRNext training")
    tensors = {}
    for name, tensor in content["state_dict"].items():
        if not isinstance(name, str) or not isinstance(tensor, Tensor):
            raise FileError(path, f"its state_dict holds {str(name)[:100]!r}, which is no tensor")
        tensors[name.removeprefix("module.")] = tensor.detach()
    return content["config"], tensors


def _is_plain(value: Any) -> bool:
    if isinstance(value, str):
        return len(value) <= _MAX_TEXT and value.isprintable()
    if isinstance(value, (list, tuple)):
        return len(value) <= 2 and all(type(item) is int and _is_plain(item) for item in value)  # noqa: PLR2004
    if isinstance(value, (int, float)):
        return math.isfinite(value) if isinstance(value, float) else abs(value) <= _MAX_INTEGER
    return value is None


def _copy_state(architecture: Architecture, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The state dict, after comparing every name, shape and type with the network's."""
    with torch.device("meta"):
        expected = CmrNext(architecture).state_dict()
    for kind, names in (
        ("lacks", expected.keys() - tensors.keys()),
        ("has the unknown", tensors.keys() - expected.keys()),
    ):
        if names:
            raise ValueError(f"{kind} weights {min(names)!r} ({len(names)} such names)")
    for name, like in expected.items():
        if tensors[name].shape != like.shape:
            network = ", ".join(f"{key} {value}" for key, value in asdict(architecture).items())
            found, wanted = tuple(tensors[name].shape), tuple(like.shape)
            raise ValueError(f"{name!r} has shape {found}, expected {wanted}, with {network}")
    return {name: _copy(name, tensors[name], like) for name, like in expected.items()}


def _copy(name: str, tensor: Tensor, like: Tensor) -> Tensor:
    """A sound copy of a tensor, in the type that the network expects."""
    if tensor.is_floating_point() != like.is_floating_point():
        raise ValueError(f"{name!r} holds numbers of type {tensor.dtype}")
    copy = torch.empty(like.shape, dtype=like.dtype).copy_(tensor)
    if not torch.isfinite(copy).all():
        raise ValueError(f"{name!r} holds values that are not finite")
    if name.endswith("running_var") and (copy < 0).any():
        raise ValueError(f"{name!r} holds variances below zero")
    return copy


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
