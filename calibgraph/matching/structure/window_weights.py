"""How much a window tells where it is: a small network on how it varies.

Leaves, grass and ragged edges match anything; a window that two clean surfaces or two shades fill
is worth many of them. The network sees neither where a window is in the view, nor the image: how
range and intensity vary over its rays, how many these are and how far apart. The package's was
trained on rendered scenes alone, see ``benchmarks.accuracy.window_weights`` and the model card in
the docs; one of one's own comes from ``calibgraph train-windows``.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_json, sha256, write_text
from calibgraph.matching.structure.window_kernels import FEATURES
from calibgraph.outputs import WINDOW_WEIGHTS_MARK

Floats = NDArray[np.float32]

PACKAGE_FILE = Path(__file__).with_name("window_weights.json")
LARGEST = 12.0  # of a logit: beyond, the weight is 0 or 1 to single precision
MAX_HOW = 500  # characters
_MOST = 256  # units of a layer of a file
_Number = Annotated[float, Field(strict=True, ge=-1e6, le=1e6)]
_Spread = Annotated[float, Field(strict=True, ge=1e-6, le=1e6)]
_Row = Annotated[list[_Number], Field(min_length=1, max_length=_MOST)]


@dataclass(frozen=True, eq=False)
class WindowNetwork:
    """A few hidden layers.

    Attributes:
        mean, spread: (f,) of the features in training.
        layers: (inputs, outputs) weights and (outputs,) biases of each layer.
        how: what it was trained on.
        sha256: of its file; empty before it is written.
    """

    mean: Array
    spread: Array
    layers: tuple[tuple[Array, Array], ...]
    how: str = ""
    sha256: str = ""

    def weights(self, features: NDArray[np.floating]) -> Floats:
        """(w,) between 0 and 1, of features (w, f)."""
        values = (features - self.mean) / self.spread
        for matrix, bias in self.layers[:-1]:
            values = _gelu(values @ matrix + bias)
        matrix, bias = self.layers[-1]
        logits = np.clip((values @ matrix + bias)[:, 0], -LARGEST, LARGEST)
        return np.asarray(1.0 / (1.0 + np.exp(-logits)), dtype=np.float32)

    @property
    def origin(self) -> dict[str, str]:
        """Its hash and what it was trained on, for the metadata of matches."""
        return {"sha256": self.sha256, "how": self.how}

    def save(self, path: Path) -> None:
        """Write it as JSON, numbers to five digits."""
        content = {
            "format": WINDOW_WEIGHTS_MARK, "how": self.how, "features": list(FEATURES),
            "mean": _rounded(self.mean), "spread": _rounded(self.spread),
            "layers": [{"matrix": [_rounded(row) for row in matrix], "bias": _rounded(bias)}
                       for matrix, bias in self.layers],
        }  # fmt: skip
        write_text(path, json.dumps(content) + "\n")


class _Layer(BaseModel):
    model_config = ConfigDict(extra="forbid")

    matrix: Annotated[list[_Row], Field(min_length=1, max_length=_MOST)]
    bias: _Row


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid")

    format: str
    how: Annotated[str, Field(max_length=MAX_HOW)]
    features: list[str]
    mean: _Row
    spread: Annotated[list[_Spread], Field(max_length=_MOST)]
    layers: Annotated[list[_Layer], Field(min_length=1, max_length=8)]


@cache
def window_network() -> WindowNetwork:
    """The network that is part of the package."""
    return load_window_network(PACKAGE_FILE)


def load_window_network(path: Path | str) -> WindowNetwork:
    """Read a network from its file.

    Raises:
        FileError: if the file is missing or malformed, or is of another kind or other features.
    """
    path = Path(path)
    read = read_json(path)
    if read.get("format") != WINDOW_WEIGHTS_MARK:
        raise FileError(
            path,
            f"no window weights: its format is not {WINDOW_WEIGHTS_MARK}; "
            "they are made by calibgraph train-windows",
        )
    content = checked_model(_File, read, path)
    if content.features != list(FEATURES):
        raise FileError(path, "its features are not those of this version; train it again")
    sizes = [len(FEATURES), *(len(layer.bias) for layer in content.layers)]
    rows = [list(map(len, layer.matrix)) for layer in content.layers]
    expected = [[outputs] * inputs for inputs, outputs in pairwise(sizes)]
    vectors = {len(content.mean), len(content.spread)}
    if vectors != {len(FEATURES)} or rows != expected or sizes[-1] != 1:
        raise FileError(path, "its layers do not fit each other, the features and one weight")
    if not content.how.isprintable():
        raise FileError(path, "its description holds control characters")
    layers = tuple((np.array(layer.matrix), np.array(layer.bias)) for layer in content.layers)
    mean, spread = np.array(content.mean), np.array(content.spread)
    return WindowNetwork(mean, spread, layers, content.how, sha256(path))


def _rounded(values: Array) -> list[float]:
    return [float(f"{value:.5g}") for value in values.tolist()]


def _gelu(values: Array) -> Array:
    """The Gaussian error linear unit, by its approximation with a hyperbolic tangent."""
    inner = math.sqrt(2 / math.pi) * values * (1.0 + 0.044715 * values * values)
    return np.asarray(0.5 * values * (1.0 + np.tanh(inner)))
