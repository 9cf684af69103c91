"""The CMRNext network: recurrent optical flow from a LiDAR depth image to a camera image.

RAFT with two feature encoders of its own, a context encoder that may read the LiDAR, and optional
uncertainty (Cattaneo and Valada, "CMRNext"; Teed and Deng, "RAFT"). Parameters are named and
shaped as in the published checkpoints.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from calibgraph.matching.cmrnext.architecture import Architecture
from calibgraph.matching.cmrnext.correlation import (
    WINDOW,
    Correlation,
    OnTheFly,
    Volume,
    volume_bytes,
)
from calibgraph.matching.cmrnext.layers import CELL, Encoder, UpdateBlock

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
        raise ValueError("device 'cuda': torch finds no GPU; use device: cpu in --config")
    use_gpu = name == "cuda" or (name == "auto" and torch.cuda.is_available())
    return torch.device("cuda" if use_gpu else "cpu")


@dataclass(frozen=True, eq=False)
class Flow:
    """The network's output for a batch of images.

    Attributes:
        flow_px: (B, 2, H, W) from LiDAR pixels to image pixels, x and y.
        sigma_px: (B, 2, H, W) its standard deviations, or None without an uncertainty head.
        step_px: (B, h, w) length of the last iteration's change, per cell.
        peak: (B, h, w) softmax share of the correlation at the target among its 9 x 9 cells.
    """

    flow_px: Tensor
    sigma_px: Tensor | None
    step_px: Tensor
    peak: Tensor


@dataclass(frozen=True, eq=False)
class _Iteration:
    flow: Tensor  # (B, 2, h, w) cells
    step: Tensor  # (B, 2, h, w) cells
    raw_sigma: Tensor | None
    hidden: Tensor


class CmrNext(nn.Module):
    """The network, in evaluation or training."""

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        hidden, features = architecture.scale(128), architecture.scale(256)
        self.fnet_img = Encoder(architecture, 3, features, nn.InstanceNorm2d)
        self.fnet_lidar = Encoder(
            architecture, architecture.lidar_channels, features, nn.InstanceNorm2d
        )
        self.cnet = Encoder(architecture, architecture.context_channels, 2 * hidden, nn.BatchNorm2d)
        self.update_block = UpdateBlock(architecture, 4 if architecture.uncertainty == "nll" else 2)
        if architecture.uncertainty == "nll_frozen":
            self.update_block_unc = UpdateBlock(architecture, 2)

    def forward(self, rgb: Tensor, lidar: Tensor, *, iterations: int = 12) -> Flow:
        """The flow after some iterations.

        Args:
            rgb: (B, 3, H, W) normalised image; H and W multiples of 64, at least 128.
            lidar: (B, C, H, W) from :func:`calibgraph.matching.cmrnext.inputs.encode_depth`.
            iterations: at least 1.
        """
        correlation = self.correlation(rgb, lidar)
        (last,) = deque(self._iterations(correlation, rgb, lidar, iterations), maxlen=1)
        weights = self._upsampling_weights(last.hidden)
        sigma = None
        if last.raw_sigma is not None:
            sigma = _upsample(F.elu(last.raw_sigma) + 2, weights)
        return Flow(
            flow_px=_upsample(CELL * last.flow, weights),
            sigma_px=sigma,
            step_px=CELL * last.step.norm(dim=1),
            peak=_peak(correlation, last.flow),
        )

    def all_flows(
        self, correlation: Correlation, rgb: Tensor, lidar: Tensor, *, iterations: int
    ) -> Iterator[Tensor]:
        """The flow (B, 2, H, W) [px] after every iteration, for training."""
        for each in self._iterations(correlation, rgb, lidar, iterations):
            yield _upsample(CELL * each.flow, self._upsampling_weights(each.hidden))

    def correlation(self, rgb: Tensor, lidar: Tensor) -> Correlation:
        """The correlation of both images' features, as a volume below ``VOLUME_BYTES_MAX``."""
        _require_size(rgb, lidar)
        features = self.fnet_lidar(lidar), self.fnet_img(rgb)
        batch, _, height, width = rgb.shape
        small = volume_bytes(batch, height, width) <= VOLUME_BYTES_MAX
        return Volume(*features) if small else OnTheFly(*features)

    def _iterations(
        self, correlation: Correlation, rgb: Tensor, lidar: Tensor, iterations: int
    ) -> Iterator[_Iteration]:
        raw = self.cnet(lidar if self.architecture.context == "lidar" else rgb)
        h, context = raw.chunk(2, dim=1)
        h, context = torch.tanh(h), F.relu(context)
        blocks = [self.update_block]
        if self.architecture.uncertainty == "nll_frozen":
            blocks.append(self.update_block_unc)
        terms = [block.gru.context_terms(context) for block in blocks]
        hiddens = [h for _ in blocks]
        grid = _identity_grid(h)
        flow = torch.zeros_like(grid).expand(len(h), -1, -1, -1)
        for _ in range(iterations):
            flow = flow.detach()  # as RAFT: gradients stay within one iteration
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


def _upsample(cells: Tensor, weights: Tensor) -> Tensor:
    """(B, 2, 8h, 8w) convex combinations of each cell's 3 x 3 neighbours, zero beyond the edge."""
    batch, channels, height, width = cells.shape
    neighbours = F.unfold(cells, 3, padding=1).view(batch, channels, 9, 1, 1, height, width)
    pixels = (weights * neighbours).sum(dim=2)  # (B, 2, 8, 8, h, w)
    return pixels.permute(0, 1, 4, 2, 5, 3).reshape(batch, channels, CELL * height, CELL * width)


def _peak(correlation: Correlation, flow: Tensor) -> Tensor:
    """(B, h, w) softmax share of the target itself in its window of the finest level."""
    window = correlation.window(_identity_grid(flow) + flow)[:, : WINDOW**2]
    return window.softmax(dim=1)[:, WINDOW**2 // 2]


def upscale(maps: Tensor, *, halved: bool, is_flow: bool = True) -> Tensor:
    """(B, C, H, W) network output at the image's own resolution; flows grow with it."""
    if not halved:
        return maps
    larger = F.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)
    return 2 * larger if is_flow else larger
