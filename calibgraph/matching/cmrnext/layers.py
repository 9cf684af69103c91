"""Layers of the CMRNext network; parameters have the names and shapes of published checkpoints."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from calibgraph.matching.cmrnext.architecture import Architecture
from calibgraph.matching.cmrnext.correlation import CHANNELS

CELL = 8
"""Pixels per cell of the feature maps."""


class _ResidualBlock(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: int, norm: type[nn.Module]) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1)
        self.norm1, self.norm2 = norm(outputs), norm(outputs)
        self.downsample: nn.Sequential | None = None
        if stride != 1:
            self.norm3 = norm(outputs)  # checkpoints hold it under both names
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride), self.norm3)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm1(self.conv1(x)))
        y = F.relu(self.norm2(self.conv2(y)))
        return F.relu((x if self.downsample is None else self.downsample(x)) + y)


class Encoder(nn.Module):
    """(B, C, H, W) image to (B, D, H/8, W/8) features."""

    def __init__(
        self, architecture: Architecture, inputs: int, outputs: int, norm: type[nn.Module]
    ) -> None:
        super().__init__()
        one, two, three = (architecture.scale(channels) for channels in (64, 96, 128))
        self.conv1 = nn.Conv2d(inputs, one, 7, 2, 3)
        self.norm1 = norm(one)
        self.layer1 = self._layer(one, one, 1, norm)
        self.layer2 = self._layer(one, two, 2, norm)
        self.layer3 = self._layer(two, three, 2, norm)
        self.conv2 = nn.Conv2d(three, outputs, 1)

    @staticmethod
    def _layer(inputs: int, outputs: int, stride: int, norm: type[nn.Module]) -> nn.Sequential:
        first = _ResidualBlock(inputs, outputs, stride, norm)
        return nn.Sequential(first, _ResidualBlock(outputs, outputs, 1, norm))

    def forward(self, x: Tensor) -> Tensor:
        """The features of an image."""
        x = F.relu(self.norm1(self.conv1(x)))
        out: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(x))))
        return out


class _MotionEncoder(nn.Module):
    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        s = architecture.scale
        self.convc1 = nn.Conv2d(CHANNELS, s(256), 1)
        self.convc2 = nn.Conv2d(s(256), s(192), 3, padding=1)
        self.convf1 = nn.Conv2d(2, s(128), 7, padding=3)
        self.convf2 = nn.Conv2d(s(128), s(64), 3, padding=1)
        self.conv = nn.Conv2d(s(192) + s(64), s(128) - 2, 3, padding=1)

    def forward(self, flow: Tensor, windows: Tensor) -> Tensor:
        a = F.relu(self.convc2(F.relu(self.convc1(windows))))
        b = F.relu(self.convf2(F.relu(self.convf1(flow))))
        m = F.relu(self.conv(torch.cat([a, b], dim=1)))
        return torch.cat([m, flow], dim=1)


class _SeparableGru(nn.Module):
    """A GRU of 1x5, then of 5x1 kernels, over [hidden, context, motion].

    The context is the same in all iterations: its part of every convolution is computed once, by
    :meth:`context_terms`.
    """

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.hidden = architecture.scale(128)
        for suffix, kernel, padding in (("1", (1, 5), (0, 2)), ("2", (5, 1), (2, 0))):
            for gate in "zrq":
                conv = nn.Conv2d(3 * self.hidden, self.hidden, kernel, padding=padding)
                setattr(self, f"conv{gate}{suffix}", conv)

    def context_terms(self, context: Tensor) -> list[Tensor]:
        """Per direction, (B, 3 * hidden, h, w): the bias and the context's part of z, r and q."""
        n = self.hidden
        terms = []
        for suffix in "12":
            convs = [getattr(self, f"conv{gate}{suffix}") for gate in "zrq"]
            weight = torch.cat([conv.weight[:, n : 2 * n] for conv in convs])
            bias = torch.cat([conv.bias for conv in convs])
            terms.append(F.conv2d(context, weight, bias, padding=convs[0].padding))
        return terms

    def forward(self, h: Tensor, terms: list[Tensor], motion: Tensor) -> Tensor:
        n = self.hidden
        for suffix, term in zip("12", terms, strict=True):
            z_conv, r_conv, q_conv = (getattr(self, f"conv{gate}{suffix}") for gate in "zrq")
            zr_weight = torch.cat(
                [self._weights_of_changing(z_conv), self._weights_of_changing(r_conv)]
            )
            zr = F.conv2d(torch.cat([h, motion], dim=1), zr_weight, padding=z_conv.padding)
            z, r = torch.sigmoid(zr + term[:, : 2 * n]).chunk(2, dim=1)
            q = F.conv2d(
                torch.cat([r * h, motion], dim=1),
                self._weights_of_changing(q_conv),
                padding=q_conv.padding,
            )
            h = torch.lerp(h, torch.tanh(q + term[:, 2 * n :]), z)
        return h

    def _weights_of_changing(self, conv: nn.Conv2d) -> Tensor:
        """The weights of the changing inputs: hidden and motion."""
        n = self.hidden
        return torch.cat([conv.weight[:, :n], conv.weight[:, 2 * n :]], dim=1)


class _FlowHead(nn.Module):
    def __init__(self, architecture: Architecture, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(architecture.scale(128), architecture.scale(256), 3, padding=1)
        self.conv2 = nn.Conv2d(architecture.scale(256), outputs, 3, padding=1)

    def forward(self, h: Tensor) -> Tensor:
        out: Tensor = self.conv2(F.relu(self.conv1(h)))
        return out


class UpdateBlock(nn.Module):
    """One iteration: motion encoder, GRU and flow head; and the mask of the upsampling."""

    def __init__(self, architecture: Architecture, outputs: int) -> None:
        super().__init__()
        self.encoder = _MotionEncoder(architecture)
        self.gru = _SeparableGru(architecture)
        self.flow_head = _FlowHead(architecture, outputs)
        self.mask = nn.Sequential(
            nn.Conv2d(architecture.scale(128), architecture.scale(256), 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(architecture.scale(256), 9 * CELL**2, 1),
        )
        # The memory layout of the correlation's windows.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(
        self, h: Tensor, terms: list[Tensor], windows: Tensor, flow: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The next hidden state, and the head's output."""
        h = self.gru(h, terms, self.encoder(flow, windows))
        return h, self.flow_head(h)
