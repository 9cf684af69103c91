"""Correlation of LiDAR cells with image cells: windows of a pyramid around given positions.

Both classes give the same numbers. :class:`Volume` computes all pairs once: fast, but its memory
grows with the square of the image. :class:`OnTheFly` computes only the requested windows.
"""

import math
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

LEVELS = 4
RADIUS = 4
WINDOW = 2 * RADIUS + 1
CHANNELS = LEVELS * WINDOW**2

_CORNERS = WINDOW + 1  # whole cells under a window at a fractional position, per axis
_CHUNK_BYTES = 32 * 2**20
_PYRAMID = sum(0.25**level for level in range(LEVELS))
_FAR = 1e6  # cells: positions are clamped before rounding to integers


class Correlation(Protocol):
    """A correlation pyramid of two feature maps."""

    device: torch.device

    def window(self, positions: Tensor) -> Tensor:
        """Correlation of each LiDAR cell with the image cells around a position.

        Args:
            positions: (B, 2, h, w) x, y in image cells of level 0.

        Returns:
            (B, 324, h, w): channel = 81 level + 9 (ox + 4) + (oy + 4), bilinear at the position /
            2^level + (ox, oy), zero outside the image.
        """
        ...


def volume_bytes(batch: int, height: int, width: int) -> int:
    """Memory of a :class:`Volume` for images of ``height`` x ``width`` pixels."""
    return math.ceil(batch * (height // 8 * (width // 8)) ** 2 * 4 * _PYRAMID)


class Volume:
    """All pairs of cells, computed once."""

    def __init__(self, lidar: Tensor, image: Tensor) -> None:
        self.device = lidar.device
        batch, channels, height, width = lidar.shape
        scaled = lidar.flatten(2).transpose(1, 2) / math.sqrt(channels)
        cells = (scaled @ image.flatten(2)).view(batch * height * width, 1, *image.shape[2:])
        self.levels = [cells]
        for _ in range(1, LEVELS):
            self.levels.append(F.avg_pool2d(self.levels[-1], 2))

    def window(self, positions: Tensor) -> Tensor:
        """See :meth:`Correlation.window`."""
        points = positions.permute(0, 2, 3, 1).reshape(-1, 2)
        windows = []
        for level, cells in enumerate(self.levels):
            index, inside, fraction = _corners(points / 2**level, cells.shape[-2:])
            found = cells.flatten(1).gather(1, index) * inside
            windows.append(_blend(found, fraction))
        return _to_maps(torch.cat(windows, dim=1), positions)


class OnTheFly:
    """Requested windows only, from pooled features: pooling and dot products commute."""

    def __init__(self, lidar: Tensor, image: Tensor) -> None:
        self.device = lidar.device
        scaled = lidar / math.sqrt(lidar.shape[1])
        self.lidar = scaled.flatten(2).transpose(1, 2).contiguous()  # (B, cells, C)
        self.levels = [image]
        for _ in range(1, LEVELS):
            self.levels.append(F.avg_pool2d(self.levels[-1], 2))
        self.rows = [level.flatten(2).transpose(1, 2).contiguous() for level in self.levels]

    def window(self, positions: Tensor) -> Tensor:
        """See :meth:`Correlation.window`."""
        batch = [self._one(i, p.flatten(1).T) for i, p in enumerate(positions)]
        return _to_maps(torch.cat(batch), positions)

    def _one(self, item: int, points: Tensor) -> Tensor:
        """(cells, 324) windows of one batch item."""
        lidar = self.lidar[item]
        size = max(1, _CHUNK_BYTES // (_CORNERS**2 * lidar.shape[1] * 4))
        windows = []
        for level, (cells, rows) in enumerate(zip(self.levels, self.rows, strict=True)):
            index, inside, fraction = _corners(points / 2**level, cells.shape[-2:])
            found = torch.cat(
                [
                    torch.bmm(rows[item][index[k : k + size]], lidar[k : k + size, :, None])[..., 0]
                    for k in range(0, len(index), size)
                ]
            )
            windows.append(_blend(found * inside, fraction))
        return torch.cat(windows, dim=1)


def _corners(points: Tensor, size: torch.Size) -> tuple[Tensor, Tensor, Tensor]:
    """The whole cells around points: (n, 100) row-major index, (n, 100) inside, (n, 2) fraction.

    All samples of a window have the same fractional part, so 10 x 10 cells give 9 x 9 samples.
    """
    height, width = size
    bounded = points.nan_to_num(_FAR).clamp(-_FAR, _FAR)
    base = bounded.floor()
    offsets = torch.arange(-RADIUS, RADIUS + 2, device=points.device)
    x = base[:, 0, None].long() + offsets  # (n, 10)
    y = base[:, 1, None].long() + offsets
    inside_x, inside_y = (x >= 0) & (x < width), (y >= 0) & (y < height)
    index = x.clamp(0, width - 1)[:, :, None] + width * y.clamp(0, height - 1)[:, None, :]
    inside = inside_x[:, :, None] & inside_y[:, None, :]
    return index.flatten(1), inside.flatten(1), bounded - base


def _blend(corners: Tensor, fraction: Tensor) -> Tensor:
    """(n, 81) bilinear samples, x slow and y fast, from (n, 100) cells."""
    grid = corners.view(-1, _CORNERS, _CORNERS)
    x, y = fraction[:, 0, None, None], fraction[:, 1, None, None]
    along_x = torch.lerp(grid[:, :-1], grid[:, 1:], x)
    return torch.lerp(along_x[:, :, :-1], along_x[:, :, 1:], y).flatten(1)


def _to_maps(rows: Tensor, positions: Tensor) -> Tensor:
    batch, _, height, width = positions.shape
    return rows.view(batch, height, width, -1).permute(0, 3, 1, 2)
