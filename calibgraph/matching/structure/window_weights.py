"""How much a window tells where it is: a small network on how it varies.

Leaves, grass and ragged edges match anything; a window that two clean surfaces or two shades fill
is worth many of them. The network sees neither where a window is in the view, nor the image: how
range and intensity vary over its rays, how many these are and how far apart. The package's was
trained on rendered scenes alone by ``tools/window_weights.py``; its model card is in the docs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.files import read_json, sha256

Floats = NDArray[np.float32]

FEATURES = (
    "depth varies", "intensity varies", "share of rays", "log range", "log spread of log range",
    "share behind", "log width", "log height", "depth beside a plane", "depth in two classes",
    "log spread of intensity", "intensity beside a trend", "intensity in two classes",
    "centre behind the median",
)  # fmt: skip

PACKAGE_FILE = Path(__file__).with_name("window_weights.json")
LARGEST = 12.0  # of a logit: beyond, the weight is 0 or 1 to single precision


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


@cache
def window_network() -> WindowNetwork:
    """The network that is part of the package."""
    read = read_json(PACKAGE_FILE)
    if read["features"] != list(FEATURES):
        raise ValueError(f"{PACKAGE_FILE.name}: is of other features; train it again")
    layers = tuple((np.array(layer["matrix"]), np.array(layer["bias"])) for layer in read["layers"])
    mean, spread = np.array(read["mean"]), np.array(read["spread"])
    return WindowNetwork(mean, spread, layers, read["how"], sha256(PACKAGE_FILE))


def _gelu(values: Array) -> Array:
    """The Gaussian error linear unit, by its approximation with a hyperbolic tangent."""
    inner = math.sqrt(2 / math.pi) * values * (1.0 + 0.044715 * values * values)
    return np.asarray(0.5 * values * (1.0 + np.tanh(inner)))
