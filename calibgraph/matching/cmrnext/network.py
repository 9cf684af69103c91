"""The CMRNext network: recurrent optical flow from a LiDAR depth image to a camera image.

RAFT with two feature encoders of its own, a context encoder that may read the LiDAR, and optional
uncertainty (Cattaneo and Valada, "CMRNext"; Teed and Deng, "RAFT"). Parameters are named and
shaped as in the published checkpoints.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from calibgraph.matching.cmrnext.architecture import Variant
from calibgraph.matching.cmrnext.correlation import (
    CHANNELS,
    WINDOW,
    Correlation,
    OnTheFly,
    Volume,
    volume_bytes,
)

CELL = 8
"""Pixels per cell of the feature maps."""

SIZE_MULTIPLE, SIZE_MIN = 64, 128
VOLUME_BYTES_MAX = 2**30
"""Above this, correlations are computed on the fly."""


def torch_device(name: str) -> torch.device:
    """``cpu``, ``cuda``, or with ``auto`` the GPU if there is one.

    Raises:
        ValueError: if it is none of these, or there is no GPU.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device {name!r}: known are auto, cpu, cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device 'cuda': torch finds no GPU; use --device cpu")
    found = name == "cuda" or (name == "auto" and torch.cuda.is_available())
    return torch.device("cuda" if found else "cpu")


@dataclass(frozen=True, eq=False)
class Flow:
    """What the network says of a batch of images.

    Attributes:
        flow_px: (B, 2, H, W) from LiDAR pixels to image pixels, x and y.
        sigma_px: (B, 2, H, W) its standard deviations, or None without an uncertainty head.
        step_px: (B, h, w) length of the last iteration's change, per cell.
        peak: (B, h, w) share of the correlation at the target, among its 9 x 9 cells, as softmax.
    """

    flow_px: Tensor
    sigma_px: Tensor | None
    step_px: Tensor
    peak: Tensor


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


class _Encoder(nn.Module):
    """(B, C, H, W) image to (B, D, H/8, W/8) features."""

    def __init__(self, variant: Variant, inputs: int, outputs: int, norm: type[nn.Module]) -> None:
        super().__init__()
        one, two, three = (variant.scaled(channels) for channels in (64, 96, 128))
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
        x = F.relu(self.norm1(self.conv1(x)))
        out: Tensor = self.conv2(self.layer3(self.layer2(self.layer1(x))))
        return out


class _MotionEncoder(nn.Module):
    def __init__(self, variant: Variant) -> None:
        super().__init__()
        s = variant.scaled
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

    The context does not change from iteration to iteration: its part of every convolution is
    computed once, by :meth:`context_terms`.
    """

    def __init__(self, variant: Variant) -> None:
        super().__init__()
        self.hidden = variant.scaled(128)
        for suffix, kernel, padding in (("1", (1, 5), (0, 2)), ("2", (5, 1), (2, 0))):
            for gate in "zrq":
                conv = nn.Conv2d(3 * self.hidden, self.hidden, kernel, padding=padding)
                setattr(self, f"conv{gate}{suffix}", conv)

    def context_terms(self, context: Tensor) -> list[Tensor]:
        """Per direction, (B, 3 * hidden, h, w): bias and context's part of z, r and q."""
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
            zr_weight = torch.cat([self._moving(z_conv), self._moving(r_conv)])
            zr = F.conv2d(torch.cat([h, motion], dim=1), zr_weight, padding=z_conv.padding)
            z, r = torch.sigmoid(zr + term[:, : 2 * n]).chunk(2, dim=1)
            q = F.conv2d(
                torch.cat([r * h, motion], dim=1), self._moving(q_conv), padding=q_conv.padding
            )
            h = torch.lerp(h, torch.tanh(q + term[:, 2 * n :]), z)
        return h

    def _moving(self, conv: nn.Conv2d) -> Tensor:
        """The weights of what changes: hidden and motion."""
        n = self.hidden
        return torch.cat([conv.weight[:, :n], conv.weight[:, 2 * n :]], dim=1)


class _FlowHead(nn.Module):
    def __init__(self, variant: Variant, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(variant.scaled(128), variant.scaled(256), 3, padding=1)
        self.conv2 = nn.Conv2d(variant.scaled(256), outputs, 3, padding=1)

    def forward(self, h: Tensor) -> Tensor:
        out: Tensor = self.conv2(F.relu(self.conv1(h)))
        return out


class _UpdateBlock(nn.Module):
    def __init__(self, variant: Variant, outputs: int) -> None:
        super().__init__()
        self.encoder = _MotionEncoder(variant)
        self.gru = _SeparableGru(variant)
        self.flow_head = _FlowHead(variant, outputs)
        self.mask = nn.Sequential(
            nn.Conv2d(variant.scaled(128), variant.scaled(256), 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(variant.scaled(256), 9 * CELL**2, 1),
        )
        # As the correlation's windows come.
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(
        self, h: Tensor, terms: list[Tensor], windows: Tensor, flow: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The next hidden state, and the head's output."""
        h = self.gru(h, terms, self.encoder(flow, windows))
        return h, self.flow_head(h)


@dataclass(frozen=True, eq=False)
class _Iteration:
    flow: Tensor  # (B, 2, h, w) cells
    step: Tensor  # (B, 2, h, w) cells
    raw_sigma: Tensor | None
    hidden: Tensor


class CmrNext(nn.Module):
    """The network, in evaluation or training.

    Args:
        variant: which one.
    """

    def __init__(self, variant: Variant) -> None:
        super().__init__()
        self.variant = variant
        hidden, features = variant.scaled(128), variant.scaled(256)
        self.fnet_img = _Encoder(variant, 3, features, nn.InstanceNorm2d)
        self.fnet_lidar = _Encoder(variant, variant.lidar_channels, features, nn.InstanceNorm2d)
        self.cnet = _Encoder(variant, variant.context_channels, 2 * hidden, nn.BatchNorm2d)
        self.update_block = _UpdateBlock(variant, 4 if variant.uncertainty == "nll" else 2)
        if variant.uncertainty == "nll_frozen":
            self.update_block_unc = _UpdateBlock(variant, 2)

    def forward(self, rgb: Tensor, lidar: Tensor, *, iterations: int = 12) -> Flow:
        """The flow after some iterations.

        Args:
            rgb: (B, 3, H, W) normalised image; H and W multiples of 64, at least 128.
            lidar: (B, C, H, W) encoded depth, see :mod:`calibgraph.cmrnext.inputs`.
            iterations: at least 1.
        """
        correlation = self.correlation(rgb, lidar)
        (last,) = deque(self._iterations(correlation, rgb, lidar, iterations), maxlen=1)
        weights = self._upsampling_weights(last.hidden)
        sigma = None
        if last.raw_sigma is not None:
            sigma = _upsampled(F.elu(last.raw_sigma) + 2, weights)
        return Flow(
            flow_px=_upsampled(CELL * last.flow, weights),
            sigma_px=sigma,
            step_px=CELL * last.step.norm(dim=1),
            peak=_peak(correlation, last.flow),
        )

    def all_flows(
        self, correlation: Correlation, rgb: Tensor, lidar: Tensor, *, iterations: int
    ) -> Iterator[Tensor]:
        """The flow (B, 2, H, W) [px] after every iteration, for training."""
        for each in self._iterations(correlation, rgb, lidar, iterations):
            yield _upsampled(CELL * each.flow, self._upsampling_weights(each.hidden))

    def correlation(self, rgb: Tensor, lidar: Tensor) -> Correlation:
        """The correlation of both images' features, as a volume if that fits into memory."""
        _require_size(rgb, lidar)
        features = self.fnet_lidar(lidar), self.fnet_img(rgb)
        batch, _, height, width = rgb.shape
        small = volume_bytes(batch, height, width) <= VOLUME_BYTES_MAX
        return Volume(*features) if small else OnTheFly(*features)

    def _iterations(
        self, correlation: Correlation, rgb: Tensor, lidar: Tensor, iterations: int
    ) -> Iterator[_Iteration]:
        raw = self.cnet(lidar if self.variant.context == "lidar" else rgb)
        h, context = raw.chunk(2, dim=1)
        h, context = torch.tanh(h), F.relu(context)
        blocks = [self.update_block]
        if self.variant.uncertainty == "nll_frozen":
            blocks.append(self.update_block_unc)
        terms = [block.gru.context_terms(context) for block in blocks]
        hiddens = [h for _ in blocks]
        grid = _identity_grid(h)
        flow = torch.zeros_like(grid).expand(len(h), -1, -1, -1)
        for _ in range(iterations):
            flow = flow.detach()  # as RAFT: each iteration learns its own step
            windows = correlation.window(grid + flow)
            outputs = []
            for i, block in enumerate(blocks):
                hiddens[i], output = block(hiddens[i], terms[i], windows, flow)
                outputs.append(output)
            both = torch.cat(outputs, dim=1)  # the flow's step, and raw uncertainty if there is one
            step, raw_sigma = both[:, :2], both[:, 2:] if both.shape[1] > 2 else None  # noqa: PLR2004
            flow = flow + step
            yield _Iteration(flow, step, raw_sigma, hiddens[0])

    def _upsampling_weights(self, h: Tensor) -> Tensor:
        """(B, 1, 9, 8, 8, h, w) weights of the 3 x 3 neighbours of every pixel's cell."""
        mask = 0.25 * self.update_block.mask(h)
        batch, _, height, width = mask.shape
        weights: Tensor = mask.view(batch, 1, 9, CELL, CELL, height, width).softmax(dim=2)
        return weights


def _require_size(rgb: Tensor, lidar: Tensor) -> None:
    height, width = rgb.shape[2:]
    fits = all(size % SIZE_MULTIPLE == 0 and size >= SIZE_MIN for size in (height, width))
    if not fits or lidar.shape[2:] != rgb.shape[2:]:
        raise ValueError(
            f"images of {tuple(rgb.shape[2:])} and {tuple(lidar.shape[2:])} pixels: expected "
            f"the same multiples of {SIZE_MULTIPLE}, at least {SIZE_MIN}"
        )


def _identity_grid(like: Tensor) -> Tensor:
    """(1, 2, h, w) each cell's own x and y."""
    height, width = like.shape[2:]
    y, x = torch.meshgrid(
        torch.arange(height, device=like.device, dtype=like.dtype),
        torch.arange(width, device=like.device, dtype=like.dtype),
        indexing="ij",
    )
    return torch.stack([x, y])[None]


def _upsampled(cells: Tensor, weights: Tensor) -> Tensor:
    """(B, 2, 8h, 8w) convex combinations of each cell's 3 x 3 neighbours, zero beyond the edge."""
    batch, channels, height, width = cells.shape
    neighbours = F.unfold(cells, 3, padding=1).view(batch, channels, 9, 1, 1, height, width)
    pixels = (weights * neighbours).sum(dim=2)  # (B, 2, 8, 8, h, w)
    return pixels.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, CELL * height, CELL * width)


def _peak(correlation: Correlation, flow: Tensor) -> Tensor:
    """(B, h, w) softmax share of the target itself in its window of the finest level."""
    window = correlation.window(_identity_grid(flow) + flow)[:, : WINDOW**2]
    return window.softmax(dim=1)[:, WINDOW**2 // 2]
