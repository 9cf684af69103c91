"""How much a window tells where it is: a small network on how it varies.

Leaves, grass and ragged edges match anything; a window that two clean surfaces or two shades fill
is worth many of them. The network sees neither where a window is in the view, nor the image: how
range and intensity vary over its rays, how many these are and how far apart. It was trained on
rendered scenes alone, see ``benchmarks.accuracy.window_weights`` and the model card in the docs.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array

Floats = NDArray[np.float32]

_LARGEST = 12.0  # of a logit: beyond, the weight is 0 or 1 to single precision


@dataclass(frozen=True, eq=False)
class WindowNetwork:
    """Two hidden layers.

    Attributes:
        mean, spread: (f,) of the features in training.
        layers: (inputs, outputs) weights and (outputs,) biases of each layer.
    """

    mean: Array
    spread: Array
    layers: tuple[tuple[Array, Array], ...]

    def weights(self, features: Array) -> Floats:
        """(w,) between 0 and 1, of features (w, f)."""
        values = (features - self.mean) / self.spread
        for matrix, bias in self.layers[:-1]:
            values = _gelu(values @ matrix + bias)
        matrix, bias = self.layers[-1]
        logits = np.clip((values @ matrix + bias)[:, 0], -_LARGEST, _LARGEST)
        return np.asarray(1.0 / (1.0 + np.exp(-logits)), dtype=np.float32)


@cache
def window_network() -> WindowNetwork:
    """The network that is part of the package."""
    text = files(__package__).joinpath("window_weights.json").read_text("utf-8")
    content = json.loads(text)
    layers = tuple((np.array(one["matrix"]), np.array(one["bias"])) for one in content["layers"])
    return WindowNetwork(np.array(content["mean"]), np.array(content["spread"]), layers)


def _gelu(values: Array) -> Array:
    """The Gaussian error linear unit, by its approximation with a hyperbolic tangent."""
    inner = math.sqrt(2 / math.pi) * (values + 0.044715 * values**3)
    return np.asarray(0.5 * values * (1.0 + np.tanh(inner)))
