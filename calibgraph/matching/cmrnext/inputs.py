"""The network's inputs: a cloud as a sparse depth image, and the camera's image.

The conventions of the published networks (rounding, scaling, padding, encoding) stop here.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.matching.cmrnext.network import SIZE_MIN, SIZE_MULTIPLE, Architecture
from calibgraph.model.rig import Camera

Image = NDArray[np.uint8]

MAX_DEPTH_M = 1000.0
"""Points farther away are left out."""

_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32)
_STD = np.array([0.229, 0.224, 0.225], dtype=np.float32)

_MARGIN_PX = 0.1  # as in the published training: at the left and upper edge
_MAX_BYTE = 255.0


class View:
    """A camera without its distortion: a pinhole of the same resolution, centre and size."""

    def __init__(self, camera: Camera, *, crop_even: bool = False) -> None:
        self.camera = camera
        k = camera.intrinsics_px
        on_axis = camera.lens.pixels_per_rad / k.fx  # less than 1 of the unified model alone
        self.focal_px, self.centre_px = on_axis * np.array([k.fx, k.fy]), np.array([k.cx, k.cy])
        self.width, self.height = (
            size - size % 2 if crop_even else size for size in (camera.width_px, camera.height_px)
        )

    def undistort(self, recorded: Image) -> Image:
        """(height, width, 3) RGB without distortion, from the recorded BGR image."""
        rgb = cv2.cvtColor(recorded, cv2.COLOR_BGR2RGB)
        if self.camera.distortion or self.camera.model != "pinhole":
            rgb = cv2.remap(rgb, *self._maps, cv2.INTER_LINEAR)
        return np.ascontiguousarray(rgb[: self.height, : self.width], dtype=np.uint8)

    def project(self, points_camera_m: Array) -> Array:
        """(n, 2) pixels of (n, 3) points in front of the camera."""
        plane = points_camera_m[:, :2] / points_camera_m[:, 2:]
        return np.asarray(plane * self.focal_px + self.centre_px)

    def distort(self, pixels_px: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) pixels of the recorded image, and which of them are inside it."""
        plane = (pixels_px - self.centre_px) / self.focal_px
        pixels, valid = self.camera.lens.project(np.column_stack([plane, np.ones(len(plane))]))
        return pixels, valid & self.camera.in_image(pixels)

    @cached_property
    def _maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Each pixel's place in the recorded image; outside it where the lens has no view."""
        shape = self.camera.height_px, self.camera.width_px
        v, u = np.indices(shape, dtype=np.float64).reshape(2, -1)
        pixels, visible = self.distort(np.column_stack([u, v]))
        x, y = np.where(visible[:, None], pixels, -1e6).astype(np.float32).T
        return x.reshape(shape), y.reshape(shape)


@dataclass(frozen=True, eq=False)
class LidarImage:
    """A cloud in a view, the nearest point per pixel.

    Attributes:
        point_index: (m,) row in the cloud of each visible point.
        pixels_px: (m, 2) exact projections.
        cells: (m, 2) row and column of their pixels.
        depth_m: (m,) depths along the camera's z axis.
        shape: height and width of the image.
        intensity: (m,) in 0..1, or NaN where the cloud has none.
    """

    point_index: NDArray[np.int64]
    pixels_px: Array
    cells: NDArray[np.int64]
    depth_m: NDArray[np.float32]
    shape: tuple[int, int]
    intensity: NDArray[np.float32]

    @staticmethod
    def render(cloud: NDArray[np.float32], T_camera_lidar: Array, view: View) -> LidarImage:
        """Project a cloud.

        Args:
            cloud: (n, 4) x y z [m] in the LiDAR frame, intensity.
            T_camera_lidar: (4, 4).
            view: of the camera.
        """
        points = cloud[:, :3].astype(np.float64) @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
        ahead = np.flatnonzero((points[:, 2] > 0) & (points[:, 2] < MAX_DEPTH_M))
        with np.errstate(over="ignore"):
            pixels = view.project(points[ahead])
        inside = (pixels >= _MARGIN_PX).all(1) & (pixels < [view.width, view.height]).all(1)
        index, pixels = ahead[inside], pixels[inside]
        cells = pixels.astype(np.int64)[:, ::-1]  # truncated, as in training
        depth = points[index, 2].astype(np.float32)
        flat = cells[:, 0] * view.width + cells[:, 1]
        order = np.lexsort((depth, flat))
        nearest = order[np.diff(flat[order], prepend=-1) > 0]
        return LidarImage(
            point_index=index[nearest],
            pixels_px=pixels[nearest],
            cells=cells[nearest],
            depth_m=depth[nearest],
            shape=(view.height, view.width),
            intensity=_scale_intensity(cloud)[index[nearest]],
        )

    def rasterize(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(height, width) image of one value per point, zero where there is no point."""
        image = np.zeros(self.shape, dtype=np.float32)
        image[self.cells[:, 0], self.cells[:, 1]] = values
        return image


def _scale_intensity(cloud: NDArray[np.float32]) -> NDArray[np.float32]:
    """(n,) intensity in 0..1; values above 1 are taken as bytes."""
    intensity = cloud[:, 3]
    finite = intensity[np.isfinite(intensity)]
    if len(finite) and finite.max() > 1.0:
        intensity = intensity / np.float32(max(_MAX_BYTE, finite.max()))
    return np.asarray(intensity, dtype=np.float32)


def lidar_channels(
    image: LidarImage, architecture: Architecture, max_depth_m: float
) -> NDArray[np.float32]:
    """(1 or 2, height, width) normalised depth, and intensity if the network reads it.

    Raises:
        DatasetError: if it reads intensity and the cloud has none.
    """
    channels = [image.rasterize(image.depth_m / np.float32(max_depth_m))]
    if architecture.reflectance:
        if not np.isfinite(image.intensity).all():
            raise DatasetError(
                "the network reads LiDAR intensity, and the cloud has none; use weights without "
                "reflectance, or clouds with intensity"
            )
        channels.append(image.rasterize(image.intensity))
    return np.stack(channels)


def halve_lidar(channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Halve the size: each 2x2 block becomes the mean of its pixels with a point."""
    c, height, width = channels.shape
    blocks = channels.reshape(c, height // 2, 2, width // 2, 2)
    count = (channels[0] > 0).reshape(height // 2, 2, width // 2, 2).sum(axis=(1, 3))
    return np.asarray(blocks.sum(axis=(2, 4)) / np.maximum(count, 1), dtype=np.float32)


def network_size(height: int, width: int) -> tuple[int, int]:
    """The smallest size that the network accepts and that holds (height, width)."""
    rows, columns = (
        max(SIZE_MIN, -(-size // SIZE_MULTIPLE) * SIZE_MULTIPLE) for size in (height, width)
    )
    return rows, columns


def rgb_tensor(image: Image, *, normalize: bool) -> Tensor:
    """(3, H, W) padded at the right and bottom with the mean colour, from (h, w, 3) RGB."""
    unit = image.astype(np.float32) / np.float32(_MAX_BYTE)
    values = (unit - _MEAN) / _STD if normalize else unit
    return _pad(torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1))))


def lidar_tensor(channels: NDArray[np.float32]) -> Tensor:
    """(1 or 2, H, W) padded with zeros at the right and bottom."""
    return _pad(torch.from_numpy(np.ascontiguousarray(channels)))


def encode_depth(lidar: Tensor, architecture: Architecture) -> Tensor:
    """The network's LiDAR input: Fourier encoding of the depth, then depth, then intensity.

    Args:
        lidar: (B, 1 or 2, H, W) normalised depth d, 0 where empty; intensity.
        architecture: of the network.

    Returns:
        (B, C, H, W): sin(pi d 2^l), cos(pi d 2^l) for l = 0 .. L - 1, then d; zero where empty.
    """
    depth = lidar[:, :1]
    angles = [depth * torch.pi * 2**level for level in range(architecture.fourier_levels)]
    waves = [wave(angle) for angle in angles for wave in (torch.sin, torch.cos)]
    return torch.cat([*waves, lidar], dim=1) * (depth > 0)


def _pad(image: Tensor) -> Tensor:
    height, width = image.shape[1:]
    rows, columns = network_size(height, width)
    return torch.nn.functional.pad(image, (0, columns - width, 0, rows - height))
