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

from factors.compiled import compiled

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

FEATURES = (
    "depth varies", "intensity varies", "share of rays", "log range", "log spread of log range",
    "share behind", "log width", "log height", "depth beside a plane", "depth in two classes",
    "log spread of intensity", "intensity beside a trend", "intensity in two classes",
    "centre behind the median",
)  # fmt: skip
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


@compiled()
def fill_features(cloud, members, counts, front, basis, out):  # type: ignore[no-untyped-def]
    """Fill the features (w, f) of windows, see ``FEATURES``.

    cloud: rays (n, 3) [m] and intensity ranks (n,); members: (w, l); counts: (w,); front: (w, l);
    basis: (w, l, 4).
    """
    rays_m, intensity_rank = cloud
    size = members.shape[1]
    inverse, shade, logs = np.empty(size), np.empty(size), np.empty(size)
    u, v, ordered = np.empty(size), np.empty(size), np.empty(size)
    for w in range(len(members)):
        n = counts[w]
        x0, y0, z0 = rays_m[members[w, 0], 0], rays_m[members[w, 0], 1], rays_m[members[w, 0], 2]
        flat, whole = math.sqrt(x0 * x0 + y0 * y0), math.sqrt(x0 * x0 + y0 * y0 + z0 * z0)
        ax, ay = (-y0 / flat, x0 / flat) if flat > 0 else (1.0, 0.0)
        sine, cosine = z0 / whole, flat / whole
        ux, uy, uz = -sine * ay, sine * ax, cosine  # up, across the ray
        depth, intensity, behind = 0.0, 0.0, 0.0
        for i in range(n):
            row = members[w, i]
            x, y, z = rays_m[row, 0], rays_m[row, 1], rays_m[row, 2]
            inverse[i] = 1.0 / math.sqrt(x * x + y * y + z * z)
            logs[i], shade[i] = -math.log(inverse[i]), intensity_rank[row]
            u[i] = (x * ax + y * ay) * inverse[i]
            v[i] = (x * ux + y * uy + z * uz) * inverse[i]
            depth += basis[w, i, 0] ** 2
            intensity += basis[w, i, 1] ** 2
            behind += 0.0 if front[w, i] else 1.0
        centre = logs[0]
        out[w, 0], out[w, 1], out[w, 2], out[w, 5] = depth, intensity, n / size, behind / n
        out[w, 9] = _in_two_classes(inverse, n, ordered)
        median = 1.0 / ordered[n // 2]
        out[w, 3], out[w, 13] = math.log(median), 1.0 - median * math.exp(-centre)
        out[w, 12] = _in_two_classes(shade, n, ordered)
        out[w, 4] = math.log(1e-3 + _centre(logs, n))
        out[w, 6], out[w, 7] = math.log(1e-5 + _centre(u, n)), math.log(1e-5 + _centre(v, n))
        _centre(inverse, n)
        out[w, 10] = math.log(1e-3 + _centre(shade, n))
        out[w, 8], out[w, 11] = _beside_trend(inverse, u, v, n), _beside_trend(shade, u, v, n)


@compiled()
def _centre(values, n):  # type: ignore[no-untyped-def]
    """Subtract the mean of the first n; their standard deviation."""
    mean, power = 0.0, 0.0
    for i in range(n):
        mean += values[i] / n
    for i in range(n):
        values[i] -= mean
        power += values[i] * values[i]
    return math.sqrt(power / n)


@compiled()
def _beside_trend(values, u, v, n):  # type: ignore[no-untyped-def]
    """The share of the variation of centred values that no linear function of u and v follows."""
    uu, uv, vv, along_u, along_v, power = 1e-12, 0.0, 1e-12, 0.0, 0.0, 0.0
    for i in range(n):
        uu, uv, vv = uu + u[i] * u[i], uv + u[i] * v[i], vv + v[i] * v[i]
        along_u, along_v = along_u + u[i] * values[i], along_v + v[i] * values[i]
        power += values[i] * values[i]
    det = uu * vv - uv * uv
    followed = (vv * along_u**2 - 2 * uv * along_u * along_v + uu * along_v**2) / det
    return 1.0 - min(followed / max(power, 1e-12), 1.0)


@compiled()
def _in_two_classes(values, n, ordered):  # type: ignore[no-untyped-def]
    """The largest share of the variation that lies between two classes (Otsu); sorts the values."""
    total, squares = 0.0, 0.0
    for i in range(n):
        k = i
        while k > 0 and ordered[k - 1] > values[i]:
            ordered[k] = ordered[k - 1]
            k -= 1
        ordered[k] = values[i]
        total, squares = total + values[i], squares + values[i] * values[i]
    variation = squares - total * total / n
    below, between = 0.0, 0.0
    for i in range(n - 1):
        below += ordered[i]
        apart = below - total * (i + 1) / n
        between = max(between, apart * apart * n / ((i + 1) * (n - i - 1)))
    return between / variation if variation > 1e-12 else 0.0  # noqa: PLR2004
