"""The CMRNext network: recurrent optical flow from a LiDAR depth image to a camera image.

RAFT with two feature encoders of its own, and a context encoder that may read the LiDAR (Cattaneo
and Valada, "CMRNext"; Teed and Deng, "RAFT"). Parameters are named and shaped as in the published
checkpoints.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from calibgraph.matching.cmrnext.correlation import (
    CHANNELS,
    WINDOW,
    Correlation,
)

FULL_WIDTH = 64
"""Channels of the published networks' first layer; every other width follows it in proportion."""

_MAX_WIDTH = 256
SIZE_MULTIPLE, SIZE_MIN = 64, 128
CELL = 8
"""Pixels per cell of the feature maps."""


def torch_device(name: str) -> torch.device:
    """``cpu``, ``cuda``, or with ``auto`` the GPU if there is one.

    Raises:
        ValueError: if it is none of these, or there is no GPU.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device {name!r}: known are auto, cpu, cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ValueError("device 'cuda': torch finds no GPU; use device: cpu in --config")
    use_gpu = name == "cuda" or (name == "auto" and torch.cuda.is_available())
    return torch.device("cuda" if use_gpu else "cpu")


@dataclass(frozen=True)
class Architecture:
    """The dimensions that differ between CMRNext networks.

    Attributes:
        fourier_levels: of the depth encoding; -1: plain depth.
        reflectance: whether the LiDAR image has a channel of intensities.
        context: which image the context encoder reads.
        width: channels of the first layer, a multiple of 8; published networks have 64.
    """

    fourier_levels: int = 12
    reflectance: bool = False
    context: Literal["lidar", "rgb"] = "lidar"
    width: int = FULL_WIDTH

    def __post_init__(self) -> None:
        if not 8 <= self.width <= _MAX_WIDTH or self.width % 8:  # noqa: PLR2004 - all parts whole
            raise ValueError(
                f"network width {self.width}: expected a multiple of 8 up to {_MAX_WIDTH}"
            )
        if not (self.fourier_levels == -1 or 1 <= self.fourier_levels <= 20):  # noqa: PLR2004
            raise ValueError(f"fourier_levels {self.fourier_levels}: expected 1 to 20, or -1")

    @property
    def lidar_channels(self) -> int:
        """Channels of the LiDAR input: 2L + 1, or 1 without encoding; 1 more with reflectance."""
        return 2 * max(self.fourier_levels, 0) + 1 + self.reflectance

    def scale(self, channels: int) -> int:
        """A layer's channels, scaled from the published width."""
        return channels * self.width // FULL_WIDTH


@dataclass(frozen=True, eq=False)
class Flow:
    """The network's output for a batch of images.

    Attributes:
        flow_px: (B, 2, H, W) from LiDAR pixels to image pixels, x and y.
        step_px: (B, h, w) length of the last iteration's change, per cell.
        peak: (B, h, w) softmax share of the correlation at the target among its 9 x 9 cells.
    """

    flow_px: Tensor
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
    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(architecture.scale(128), architecture.scale(256), 3, padding=1)
        self.conv2 = nn.Conv2d(architecture.scale(256), 2, 3, padding=1)

    def forward(self, h: Tensor) -> Tensor:
        out: Tensor = self.conv2(F.relu(self.conv1(h)))
        return out


class UpdateBlock(nn.Module):
    """One iteration: motion encoder, GRU and flow head; and the mask of the upsampling."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.encoder = _MotionEncoder(architecture)
        self.gru = _SeparableGru(architecture)
        self.flow_head = _FlowHead(architecture)
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
        """The next hidden state, and the step of the flow."""
        h = self.gru(h, terms, self.encoder(flow, windows))
        return h, self.flow_head(h)


class CmrNext(nn.Module):
    """The network."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        hidden, features = architecture.scale(128), architecture.scale(256)
        self.fnet_img = Encoder(architecture, 3, features, nn.InstanceNorm2d)
        self.fnet_lidar = Encoder(
            architecture, architecture.lidar_channels, features, nn.InstanceNorm2d
        )
        read = architecture.lidar_channels if architecture.context == "lidar" else 3
        self.cnet = Encoder(architecture, read, 2 * hidden, nn.BatchNorm2d)
        self.update_block = UpdateBlock(architecture)

    def forward(self, rgb: Tensor, lidar: Tensor, *, iterations: int = 12) -> Flow:
        """The flow after some iterations.

        Args:
            rgb: (B, 3, H, W) normalised image; H and W multiples of 64, at least 128.
            lidar: (B, C, H, W) from :func:`calibgraph.matching.cmrnext.inputs.encode_depth`.
            iterations: at least 1.
        """
        _require_size(rgb, lidar)
        correlation = Correlation(self.fnet_lidar(lidar), self.fnet_img(rgb))
        h, context = self.cnet(lidar if self.architecture.context == "lidar" else rgb).chunk(2, 1)
        h, context = torch.tanh(h), F.relu(context)
        terms = self.update_block.gru.context_terms(context)
        grid = _identity_grid(h)
        flow = torch.zeros_like(grid).expand(len(h), -1, -1, -1)
        for _ in range(iterations):
            h, step = self.update_block(h, terms, correlation.window(grid + flow), flow)
            flow = flow + step
        # (B, 1, 9, 8, 8, h, w) of the 3 x 3 neighbours of every pixel's cell.
        mask = 0.25 * self.update_block.mask(h)
        weights = mask.view(len(mask), 1, 9, CELL, CELL, *mask.shape[2:]).softmax(dim=2)
        # The softmax share of the target itself in its window of the finest level.
        window = correlation.window(grid + flow)[:, : WINDOW**2]
        return Flow(
            flow_px=_upsample(CELL * flow, weights),
            step_px=CELL * step.norm(dim=1),
            peak=window.softmax(dim=1)[:, WINDOW**2 // 2],
        )


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


def _upsample(cells: Tensor, weights: Tensor) -> Tensor:
    """(B, 2, 8h, 8w) convex combinations of each cell's 3 x 3 neighbours, zero beyond the edge."""
    batch, channels, height, width = cells.shape
    neighbours = F.unfold(cells, 3, padding=1).view(batch, channels, 9, 1, 1, height, width)
    pixels = (weights * neighbours).sum(dim=2)  # (B, 2, 8, 8, h, w)
    return pixels.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, CELL * height, CELL * width)


def upscale(flow_px: Tensor, *, halved: bool) -> Tensor:
    """(B, 2, H, W) flow at the image's own resolution."""
    if not halved:
        return flow_px
    return 2 * F.interpolate(flow_px, scale_factor=2, mode="bilinear", align_corners=False)
