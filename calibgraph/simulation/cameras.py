"""Cameras in a simulated world: the rays of a lens, and pictures."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera
from calibgraph.simulation.world import World, cast, shade
from factors import unproject

Floats = NDArray[np.float32]
Image = NDArray[np.uint8]

SAMPLES_PX = np.array([[-0.375, 0.125], [-0.125, -0.375], [0.125, 0.375], [0.375, -0.125]])
"""Sample positions from a pixel's centre: no two in one row or column, so that edges are smooth."""
MAX_FIELD_RAD = math.radians(95.0)
_BLUR_PX, _NOISE, _EXPOSURE_SPREAD, _GAMMA = 0.45, 0.008, 0.08, 1 / 2.2
_BLOCK_PX = 2**17


@dataclass(frozen=True, eq=False)
class CameraRays:
    """The rays of a camera.

    Attributes:
        directions: (height, width, samples, 3) unit vectors in the camera's frame; 0 outside
            the field of view.
        blind: (height, width) pixels outside the field of view, which stay black.
        pixel_rad: approximate angular width of a pixel.
    """

    directions: Floats
    blind: NDArray[np.bool_]
    pixel_rad: float


def camera_rays(camera: Camera) -> CameraRays:
    """Cast rays through the samples of every pixel."""
    v, u = np.indices((camera.height_px, camera.width_px), dtype=np.float64)
    pixels = np.stack([u, v], axis=-1)[:, :, None] + SAMPLES_PX
    rays = pixel_directions(camera, pixels.reshape(-1, 2)).astype(np.float32)
    rays = rays.reshape(*pixels.shape[:3], 3)
    blind = np.asarray(~np.all(rays.any(axis=3), axis=2))
    return CameraRays(directions=rays, blind=blind, pixel_rad=1 / camera.lens.pixels_per_rad)


def pixel_directions(camera: Camera, pixels_px: Array) -> Array:
    """Viewing directions of pixels: the inverse of the lens's projection.

    Args:
        camera: its lens.
        pixels_px: (n, 2) column and row.

    Returns:
        (n, 3) unit vectors in the camera's frame; 0 where the lens projects no direction to the
        pixel, or, as a fisheye, one more than 95 degrees off its axis.
    """
    directions, valid = unproject(camera.lens, pixels_px)
    if camera.model == "fisheye":
        valid &= directions[:, 2] >= math.cos(MAX_FIELD_RAD)
    return np.asarray(np.where(valid[:, None], directions, 0.0))


def develop(linear: Floats, rng: np.random.Generator) -> Image:
    """The BGR image of linear light, with an exposure, optical blur and noise."""
    linear = linear * np.float32(math.exp(rng.normal(0, _EXPOSURE_SPREAD)))
    image = np.asarray(cv2.GaussianBlur(linear, (0, 0), _BLUR_PX)) ** _GAMMA
    image += np.float32(_NOISE) * rng.standard_normal(image.shape, np.float32)
    return (255 * image.clip(0, 1) + 0.5).astype(np.uint8)


def trace_light(world: World, rays: CameraRays, T_world_camera: Array) -> Floats:
    """(height, width, 3) linear BGR light on the pixels; black outside the field of view.

    T_world_camera: (4, 4); camera x is right, y down, z forward.
    """
    height, width = rays.directions.shape[:2]
    rows = max(1, _BLOCK_PX // width)
    blocks = [rays.directions[row : row + rows] for row in range(0, height, rows)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        parts = pool.map(
            lambda block: _trace_block(world, block, T_world_camera, rays.pixel_rad), blocks
        )
        image = np.concatenate(list(parts))
    image[rays.blind] = 0
    return image


def _trace_block(
    world: World, directions: Floats, T_world_camera: Array, pixel_rad: float
) -> Floats:
    """(rows, width, 3) light on some rows of pixels."""
    outwards = directions.reshape(-1, 3) @ T_world_camera[:3, :3].T.astype(np.float32)
    origin = T_world_camera[:3, 3]
    hits = cast(world, origin, outwards)
    light = shade(world, origin, outwards, hits, pixel_rad=pixel_rad).reshape(directions.shape)
    total = light[:, :, 0] + light[:, :, 1] + light[:, :, 2] + light[:, :, 3]  # as mean() is slow
    return np.asarray(total / len(SAMPLES_PX))
