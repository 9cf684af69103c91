"""Weights from files: strictly, safely, and with a hash of what was read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from calibgraph.cmrnext.network import CmrNext
from calibgraph.cmrnext.pickle_reader import read_checkpoint
from calibgraph.cmrnext.variant import Variant, recognised, require_config_agrees
from calibgraph.errors import FileError
from calibgraph.files import sha256, write_atomically

SAFETENSORS = ".safetensors"

DOWNLOAD = (
    "the published weights are at "
    "https://cmrnext.cs.uni-freiburg.de/downloads/cmrnext_calibration_weights.zip; they are not "
    "part of calibgraph: GPL-3.0 for academic use, for other use ask their authors; or train your "
    "own with calibgraph train"
)

_REQUIRED: dict[str, Any] = {
    "max_depth": (int, float),
    "use_reflectance": bool,
    "normalize_images": bool,
}


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """A network's weights and what they were made for.

    Attributes:
        path: of the file.
        sha256: of the file.
        variant: of the network, recognised from the shapes.
        config: what the file says of its training; plain values only.
        state: the state dict.
    """

    path: Path
    sha256: str
    variant: Variant
    config: dict[str, Any]
    state: dict[str, Tensor]

    @property
    def max_depth_m(self) -> float:
        """What depths are divided by."""
        return float(self.config["max_depth"])

    @property
    def range_deg_m(self) -> tuple[float, float] | None:
        """Largest perturbation per axis in training, degrees and metres, if the file says."""
        values = [self.config.get(key) for key in ("max_r", "max_t")]
        if all(isinstance(v, (int, float)) and 0 < v < float("inf") for v in values):
            return float(values[0]), float(values[1])  # type: ignore[arg-type]
        return None

    def summary(self) -> dict[str, Any]:
        """What the file holds, as plain values."""
        return {
            "file": str(self.path),
            "sha256": self.sha256,
            "parameters": sum(t.numel() for name, t in self.state.items() if not _copied(name)),
            "network": asdict(self.variant),
            "config": self.config,
        }

    def network(self, device: str | torch.device = "cpu") -> CmrNext:
        """The network with these weights, for evaluation."""
        model = CmrNext(self.variant)
        model.load_state_dict(self.state)
        return model.to(device).eval()

    def save_safetensors(self, path: Path) -> None:
        """Write the weights and their config as a .safetensors file."""
        from safetensors.torch import save_file

        metadata = {"format": "calibgraph-cmrnext/1", "config": json.dumps(self.config)}
        # Some tensors are stored under two names; safetensors wants them apart.
        state = {name: tensor.clone().contiguous() for name, tensor in self.state.items()}
        write_atomically(path, lambda temporary: save_file(state, temporary, metadata))


def _copied(name: str) -> bool:
    """Whether a state dict's entry is no parameter: a second name, or a running statistic."""
    return ".downsample.1." in name or name.endswith(
        ("running_mean", "running_var", "num_batches_tracked")
    )


def load_checkpoint(path: Path | str) -> Checkpoint:
    """Read weights, from a published ``.tar`` (``torch.save``) or a ``.safetensors``.

    Nothing in the file is executed.

    Raises:
        FileError: if the file is missing, damaged, hostile, not of a CMRNext network, or differs
            from what it says of itself.
    """
    path = Path(path)
    if not path.is_file():
        raise FileError(path, f"no such file of weights; {DOWNLOAD}")
    config, arrays = _read_safetensors(path) if path.suffix == SAFETENSORS else _read_torch(path)
    try:
        _require_keys(config)
        shapes = {name: array.shape for name, array in arrays.items()}
        variant = recognised(shapes, reflectance=config["use_reflectance"])
        require_config_agrees(variant, config)
        state = _checked_state(variant, arrays)
    except ValueError as error:
        raise FileError(path, f"{error}") from None
    return Checkpoint(path, sha256(path), variant, config, state)


def training_state(path: Path) -> Mapping[str, Any]:
    """Everything in a checkpoint that ``calibgraph train`` wrote, tensors as arrays."""
    return read_checkpoint(path)


def _read_torch(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    content = read_checkpoint(path)
    for key in ("config", "state_dict"):
        if not isinstance(content.get(key), dict):
            raise FileError(path, f"lacks {key!r}: expected the checkpoint of a CMRNext training")
    arrays = {}
    for name, array in content["state_dict"].items():
        if not isinstance(name, str) or not isinstance(array, np.ndarray):
            raise FileError(path, f"its state_dict holds {name!r}, which is not a tensor")
        arrays[name.removeprefix("module.")] = array
    plain = (bool, int, float, str, type(None))
    config = {
        key: value
        for key, value in content["config"].items()
        if isinstance(key, str) and isinstance(value, plain)
    }
    return config, arrays


def _read_safetensors(path: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        config = json.loads(metadata["config"])
    except KeyError:
        raise FileError(
            path, "has no config in its metadata; convert the original with calibgraph weights"
        ) from None
    except (SafetensorError, ValueError, OSError, RecursionError) as error:
        text = " ".join(str(error).split())
        raise FileError(path, f"cannot be read as safetensors: {text}") from None
    if not isinstance(config, dict):
        raise FileError(path, "its config is not a mapping")
    return config, arrays


def _require_keys(config: Mapping[str, Any]) -> None:
    for key, kinds in _REQUIRED.items():
        if key not in config:
            raise ValueError(f"its config lacks {key!r}")
        if not isinstance(config[key], kinds):
            raise ValueError(f"its config has {key} = {config[key]!r}, of the wrong kind")
    if not 0 < config["max_depth"] < float("inf"):
        raise ValueError(f"its config has max_depth = {config['max_depth']!r}, expected metres")


def _checked_state(variant: Variant, arrays: Mapping[str, NDArray[Any]]) -> dict[str, Tensor]:
    """The state dict, after comparing every name and shape with the network's.

    Raises:
        ValueError: on the first difference, and on numbers that are not finite.
    """
    with torch.device("meta"):
        expected = CmrNext(variant).state_dict()
    for kind, names in (
        ("lacks", expected.keys() - arrays.keys()),
        ("has the unknown", arrays.keys() - expected.keys()),
    ):
        if names:
            raise ValueError(f"{kind} weights {min(names)!r} ({len(names)} such names)")
    state = {}
    for name, like in expected.items():
        array = arrays[name]
        if array.shape != tuple(like.shape):
            raise ValueError(f"{name!r} has shape {array.shape}, expected {tuple(like.shape)}")
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name!r} holds {array.dtype}, expected numbers")
        state[name] = torch.tensor(np.array(array)).to(like.dtype)
        if not torch.isfinite(state[name]).all():
            raise ValueError(f"{name!r} holds values that are not finite")
        if name.endswith("running_var") and (state[name] < 0).any():
            raise ValueError(f"{name!r} holds variances below zero")
    for name, tensor in state.items():
        if ".norm3." in name and not torch.equal(
            tensor, state[name.replace(".norm3.", ".downsample.1.")]
        ):
            raise ValueError(f"{name!r} and its copy under 'downsample.1' differ")
    return state
