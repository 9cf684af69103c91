"""Training samples: a frame with a trusted extrinsic, seen from a perturbed one.

The image is also turned at random together with its true extrinsic, so that the truth is another in
every sample: the network cannot learn it by heart, it has to compare image and cloud.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional as F

from calibgraph.io.dataset import Frame
from calibgraph.matching.cmrnext.architecture import Variant
from calibgraph.matching.cmrnext.inputs import (
    LidarImage,
    View,
    encoded,
    halved_lidar,
    lidar_channels,
    lidar_tensor,
    rgb_tensor,
)
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Camera

Array = NDArray[np.float64]

MIN_POINTS = 50
_ROLL_DEG, _TURN_DEG = 5.0, 3.0
_JITTER = 0.2
_BORDER = cv2.BORDER_REFLECT_101  # a black one would show how the picture was turned
_MAX_DOWN_M = 1.0  # the virtual camera stays above the ground


@dataclass(frozen=True, eq=False)
class Sample:
    """One pair of network inputs and the flow that it should find.

    Attributes:
        rgb: (3, h, w) normalised image of the network's size.
        lidar: (1 or 2, h, w) normalised depth, intensity.
        cells: (m, 2) row and column of each point in the full-resolution image.
        flow_px: (m, 2) its true flow, full-resolution pixels.
        size: height and width of the full-resolution image.
        pixels_px: (m, 2) exact pixel of each point in the view, before cropping.
        points_camera_m: (m, 3) each point in the true camera's frame.
        E: (4, 4) the perturbation.
    """

    rgb: Tensor
    lidar: Tensor
    cells: Tensor
    flow_px: Tensor
    size: tuple[int, int]
    pixels_px: Array
    points_camera_m: Array
    E: Array


def perturbation(rng: np.random.Generator, rotation_deg: float, translation_m: float) -> Array:
    """(4, 4) E = trans(t) R of the published protocol, uniform per axis of the camera.

    Never more than 1 m downwards. The perturbed extrinsic is E^-1 T_camera_lidar.
    """
    E = np.eye(4)
    angles = rng.uniform(-rotation_deg, rotation_deg, 3)
    E[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    high = np.array([translation_m, min(translation_m, _MAX_DOWN_M), translation_m])
    E[:3, 3] = rng.uniform(-translation_m, high)
    return E


@dataclass(frozen=True)
class SampleSettings:
    """How samples are made.

    Attributes:
        rotation_deg, translation_m: largest perturbation per axis.
        max_depth_m: what depths are divided by.
        half_resolution: whether the network sees half the image's size.
        crop_px: height and width of a random crop, at full resolution; None: the whole image.
        augment: mirror, turn and recolour at random.
    """

    rotation_deg: float
    translation_m: float
    max_depth_m: float
    half_resolution: bool
    crop_px: tuple[int, int] | None
    augment: bool


@dataclass(frozen=True)
class Scene:
    """One camera's image and the cloud of one frame; the camera's pose is trusted."""

    frame: Frame
    name: str
    camera: Camera


def make_sample(
    scene: Scene,
    *,
    settings: SampleSettings,
    variant: Variant,
    rng: np.random.Generator,
) -> Sample | None:
    """A sample of a scene; None if too few points are in the picture."""
    view = View(scene.camera, crop_even=True)
    image = view.image(scene.frame.load_image(scene.name, scene.camera))
    cloud = scene.frame.load_cloud().astype(np.float64)
    T = scene.camera.T_camera_lidar
    cloud[:, :3] = cloud[:, :3] @ T[:3, :3].T + T[:3, 3]  # from here on, in the true camera frame
    if settings.augment:
        image, cloud = _mirrored(_recoloured(image, rng), cloud, view, rng)
        image, cloud = _turned(image, cloud, view, rng)
    E: Array = perturbation(rng, settings.rotation_deg, settings.translation_m)
    seen = LidarImage.of(cloud.astype(np.float32), invert(E), view)
    truth = cloud[seen.point_index, :3]
    ahead = truth[:, 2] > 0
    seen, truth = seen.select(ahead), truth[ahead]
    flow = view.project(truth) - seen.pixels_px
    corner, size = _crop(seen.shape, settings.crop_px, rng)
    cells = seen.cells - corner
    inside = ((cells >= 0) & (cells < size)).all(axis=1) & (np.abs(flow) < 1000).all(axis=1)  # noqa: PLR2004
    if np.count_nonzero(inside) < MIN_POINTS:
        return None
    (top, left), (height, width) = corner, size
    image = image[top : top + height, left : left + width]
    channels = lidar_channels(seen, variant, settings.max_depth_m)
    channels = channels[:, top : top + height, left : left + width]
    if settings.half_resolution:
        image, channels = image[::2, ::2], halved_lidar(channels)
    return Sample(
        rgb=rgb_tensor(image, normalize=True),
        lidar=lidar_tensor(channels),
        cells=torch.from_numpy(cells[inside]),
        flow_px=torch.from_numpy(flow[inside].astype(np.float32)),
        size=(height, width),
        pixels_px=seen.pixels_px[inside],
        points_camera_m=truth[inside],
        E=E,
    )


def network_inputs(samples: list[Sample], variant: Variant) -> tuple[Tensor, Tensor]:
    """(B, 3, H, W) and (B, C, H, W): a batch for the network."""
    return (
        torch.stack([sample.rgb for sample in samples]),
        encoded(torch.stack([sample.lidar for sample in samples]), variant),
    )


def at_full_resolution(maps: Tensor, *, halved: bool, is_flow: bool = True) -> Tensor:
    """(B, C, H, W) network output at the image's own resolution; flows grow with it."""
    if not halved:
        return maps
    larger = F.interpolate(maps, scale_factor=2, mode="bilinear", align_corners=False)
    return 2 * larger if is_flow else larger


def _recoloured(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Brightness, contrast and saturation changed at random."""
    brightness, contrast, saturation = rng.uniform(1 - _JITTER, 1 + _JITTER, 3)
    values = image.astype(np.float32) * np.float32(brightness)
    mean = values.mean()
    values = (values - mean) * np.float32(contrast) + mean
    gray = values.mean(axis=2, keepdims=True)
    values = (values - gray) * np.float32(saturation) + gray
    return np.asarray(values.clip(0, 255), dtype=np.uint8)


def _mirrored(
    image: NDArray[np.uint8], cloud: Array, view: View, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], Array]:
    """Left and right exchanged, half of the time; the principal point stays where it was."""
    if rng.random() < 0.5:  # noqa: PLR2004 - half of the time
        return image, cloud
    shift = 2 * view.centre_px[0] - (view.width - 1)  # the mirror image's centre back to cx
    move = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]])
    flipped = np.ascontiguousarray(image[:, ::-1])
    size = (view.width, view.height)
    image = np.asarray(cv2.warpAffine(flipped, move, size, borderMode=_BORDER), dtype=np.uint8)
    return image, cloud * np.array([-1.0, 1.0, 1.0, 1.0])


def _turned(
    image: NDArray[np.uint8], cloud: Array, view: View, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], Array]:
    """The camera turned about its own centre, the picture warped accordingly."""
    angles = rng.uniform(-1, 1, 3) * [_TURN_DEG, _TURN_DEG, _ROLL_DEG]
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    K = np.diag([*view.focal_px, 1.0])
    K[:2, 2] = view.centre_px
    homography = K @ R @ np.linalg.inv(K)
    size = (view.width, view.height)
    warped = cv2.warpPerspective(image, homography, size, borderMode=_BORDER)
    cloud = np.column_stack([cloud[:, :3] @ R.T, cloud[:, 3:]])
    return np.asarray(warped, dtype=np.uint8), cloud


def _crop(
    shape: tuple[int, int], crop_px: tuple[int, int] | None, rng: np.random.Generator
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Corner and size of a random crop; even, so that halving fits."""
    if crop_px is None:
        return np.zeros(2, np.int64), shape
    height, width = (min(size, most) for size, most in zip(shape, crop_px, strict=True))
    corner = [2 * int(rng.integers(0, (full - part) // 2 + 1))
              for full, part in zip(shape, (height, width), strict=True)]  # fmt: skip
    return np.array(corner, dtype=np.int64), (height, width)
