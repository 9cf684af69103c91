"""Correlation of LiDAR cells with image cells: windows of a pyramid around given positions."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

MOST_BYTES = 2**30
LEVELS = 4
RADIUS = 4
WINDOW = 2 * RADIUS + 1
CHANNELS = LEVELS * WINDOW**2

_CORNERS = WINDOW + 1  # whole cells under a window at a fractional position, per axis
_CHUNK_BYTES = 32 * 2**20
_PYRAMID = sum(0.25**level for level in range(LEVELS))
_FAR = 1e6  # cells: positions are clamped before rounding to integers


class Correlation:
    """A correlation pyramid of two feature maps.

    All pairs of cells are computed once, which is fast, unless that takes more than ``most_bytes``:
    it grows with the square of the image. Then only the requested windows are, from pooled
    features: pooling and dot products commute. The numbers are the same.
    """

    def __init__(self, lidar: Tensor, image: Tensor, most_bytes: float = MOST_BYTES) -> None:
        batch, channels, height, width = lidar.shape
        self.lidar = (lidar / math.sqrt(channels)).flatten(2).transpose(1, 2).contiguous()
        self.is_whole = batch * (height * width) ** 2 * 4 * _PYRAMID <= most_bytes
        if self.is_whole:
            image = (self.lidar @ image.flatten(2)).view(-1, 1, *image.shape[2:])
        self.levels = [image]
        for _ in range(1, LEVELS):
            self.levels.append(F.avg_pool2d(self.levels[-1], 2))
        self.rows = [level.flatten(2).transpose(1, 2).contiguous() for level in self.levels]

    def window(self, positions: Tensor) -> Tensor:
        """Correlation of each LiDAR cell with the image cells around a position.

        Args:
            positions: (B, 2, h, w) x, y in image cells of level 0.

        Returns:
            (B, 324, h, w): channel = 81 level + 9 (ox + 4) + (oy + 4), bilinear at the position /
            2^level + (ox, oy), zero outside the image.
        """
        batch, _, height, width = positions.shape
        points, windows = positions.permute(0, 2, 3, 1).reshape(-1, 2), []
        for level, rows in enumerate(self.rows):
            index, inside, fraction = _corners(points / 2**level, self.levels[level].shape[-2:])
            found = rows[..., 0].gather(1, index) if self.is_whole else self._products(rows, index)
            windows.append(_blend(found * inside, fraction))
        channels = torch.cat(windows, dim=1).view(batch, height, width, -1)
        return channels.permute(0, 3, 1, 2)

    def _products(self, rows: Tensor, index: Tensor) -> Tensor:
        """(n, 100) products of each LiDAR cell with the (B, cells, C) image cells of its window."""
        size = max(1, _CHUNK_BYTES // (_CORNERS**2 * rows.shape[2] * 4))
        return torch.cat([
            torch.bmm(image[wanted[k : k + size]], lidar[k : k + size, :, None])[..., 0]
            for lidar, image, wanted in zip(
                self.lidar, rows, index.view(len(rows), -1, _CORNERS**2), strict=True
            )
            for k in range(0, len(wanted), size)
        ])  # fmt: skip


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
