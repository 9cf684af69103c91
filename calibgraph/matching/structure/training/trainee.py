"""A network of the windows' weights in torch."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from calibgraph.matching.structure.window_weights import LARGEST, WindowNetwork


class Trainee:
    """The network that is trained, from one that is known; the features' units stay as they are.

    Args:
        start: the network to begin with.
    """

    def __init__(self, start: WindowNetwork) -> None:
        self._mean, self._spread = torch.as_tensor(start.mean), torch.as_tensor(start.spread)
        self._linear = []
        for matrix, bias in start.layers:
            layer = torch.nn.Linear(*matrix.shape)
            layer.weight.data = torch.tensor(matrix.T, dtype=torch.float32)
            layer.bias.data = torch.tensor(bias, dtype=torch.float32)
            self._linear.append(layer)
        *hidden, last = self._linear
        gelus = [(layer, torch.nn.GELU(approximate="tanh")) for layer in hidden]
        self.layers = torch.nn.Sequential(*(module for pair in gelus for module in pair), last)

    def weights(self, features: NDArray[np.float32], noise: float = 0.0) -> Tensor:
        """(w,) of windows with features (w, f), differentiable, with noise on the features."""
        values = (torch.as_tensor(features).double() - self._mean) / self._spread
        values = (values + noise * torch.randn_like(values)).float()
        logits: Tensor = self.layers(values).clamp(-LARGEST, LARGEST)[:, 0]
        return torch.sigmoid(logits)

    def to_network(self, how: str) -> WindowNetwork:
        """As the matcher uses it, with a description of its training."""
        layers = [(layer.weight.detach().T, layer.bias.detach()) for layer in self._linear]
        return WindowNetwork(
            self._mean.numpy(), self._spread.numpy(),
            tuple((matrix.double().numpy(), bias.double().numpy()) for matrix, bias in layers),
            how,
        )  # fmt: skip
