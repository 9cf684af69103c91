"""Training samples: a scene's cloud rendered with a perturbed extrinsic, and the true flow.

Image and true extrinsic are also rotated together at random: the truth differs in every sample, so
that the network cannot memorise it and has to compare image and cloud.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from calibgraph.arrays import Array
from calibgraph.io.frame import Frame
from calibgraph.matching.cmrnext.architecture import Architecture
from calibgraph.matching.cmrnext.inputs import (
    LidarImage,
    View,
    encode_depth,
    halve_lidar,
    lidar_channels,
    lidar_tensor,
    rgb_tensor,
)
from calibgraph.matching.cmrnext.training.settings import TrainSettings
from calibgraph.model.geometry import invert, transform
from calibgraph.model.rig import Camera

MIN_POINTS = 50
_ROLL_DEG, _TURN_DEG = 5.0, 3.0
_JITTER = 0.2
_BORDER = cv2.BORDER_REFLECT_101  # a black border would reveal the rotation
_MAX_DOWN_M = 1.0  # the virtual camera stays above the ground
_MAX_FLOW_PX = 1000.0


@dataclass(frozen=True)
class Scene:
    """One camera's image and the cloud of one frame."""

    frame: Frame
    name: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class Sample:
    """One pair of network inputs and its true flow.

    Attributes:
        rgb: (3, h, w) normalised image of the network's size.
        lidar: (1 or 2, h, w) normalised depth, intensity.
        cells: (m, 2) row and column of each point in the full-resolution image.
        flow_px: (m, 2) its true flow, full-resolution pixels.
        size: height and width of the full-resolution image.
        pixels_px: (m, 2) exact pixel of each point in the view, before cropping.
        points_camera_m: (m, 3) each point in the true camera's frame.
        E: (4, 4) the perturbation.
        view: the camera without its distortion.
    """

    rgb: Tensor
    lidar: Tensor
    cells: Tensor
    flow_px: Tensor
    size: tuple[int, int]
    pixels_px: Array
    points_camera_m: Array
    E: Array
    view: View


def draw_perturbation(rng: np.random.Generator, rotation_deg: float, translation_m: float) -> Array:
    """(4, 4) E = trans(t) R of the published protocol, uniform per axis of the camera.

    Never more than 1 m downwards. The perturbed extrinsic is E^-1 T_camera_lidar.
    """
    angles = rng.uniform(-rotation_deg, rotation_deg, 3)
    high = np.array([translation_m, min(translation_m, _MAX_DOWN_M), translation_m])
    turn = Rotation.from_euler("xyz", angles, degrees=True)
    return transform(turn, rng.uniform(-translation_m, high))


def make_sample(
    scene: Scene, settings: TrainSettings, rng: np.random.Generator, *, augment: bool
) -> Sample | None:
    """Perturb a scene's extrinsic; None if too few points are in the image.

    Args:
        scene: with its trusted extrinsic.
        settings: of the training.
        rng: for all draws.
        augment: mirror, rotate, recolour and crop at random, for training; else the whole image.
    """
    view = View(scene.camera, crop_even=True)
    image, cloud = _load(scene, view)
    if augment:
        image, cloud = _augment(image, cloud, view, rng)
    E = draw_perturbation(rng, settings.rotation_deg, settings.translation_m)
    lidar = LidarImage.render(cloud.astype(np.float32), invert(E), view)
    truth = cloud[lidar.point_index, :3]
    ahead = truth[:, 2] > 0
    lidar, truth = lidar.select(ahead), truth[ahead]
    flow = view.project(truth) - lidar.pixels_px
    corner, (height, width) = _draw_crop(lidar.shape, settings.crop_px if augment else None, rng)
    cells = lidar.cells - corner
    inside = ((cells >= 0) & (cells < (height, width))).all(axis=1)
    inside &= (np.abs(flow) < _MAX_FLOW_PX).all(axis=1)
    if np.count_nonzero(inside) < MIN_POINTS:
        return None
    rows, columns = (slice(a, a + n) for a, n in zip(corner, (height, width), strict=True))
    rgb, depth = _to_tensors(
        image[rows, columns],
        lidar_channels(lidar, settings.architecture, settings.max_depth_m)[:, rows, columns],
        halved=settings.half_resolution,
    )
    return Sample(
        rgb=rgb,
        lidar=depth,
        cells=torch.from_numpy(cells[inside]),
        flow_px=torch.from_numpy(flow[inside].astype(np.float32)),
        size=(height, width),
        pixels_px=lidar.pixels_px[inside],
        points_camera_m=truth[inside],
        E=E,
        view=view,
    )


def _augment(
    image: NDArray[np.uint8], cloud: Array, view: View, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], Array]:
    """Other colours, mirrored or not, turned about the optical axis."""
    image, cloud = _mirror(_recolour(image, rng), cloud, view, rng)
    return _turn(image, cloud, view, rng)


def _load(scene: Scene, view: View) -> tuple[NDArray[np.uint8], Array]:
    """(h, w, 3) RGB without distortion; (n, 4) x y z [m] in the true camera frame, intensity."""
    image = view.undistort(scene.frame.load_image(scene.name, scene.camera))
    cloud = scene.frame.load_cloud().astype(np.float64)
    T_camera_lidar = scene.camera.T_camera_lidar
    cloud[:, :3] = cloud[:, :3] @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
    return image, cloud


def _to_tensors(
    image: NDArray[np.uint8], channels: NDArray[np.float32], *, halved: bool
) -> tuple[Tensor, Tensor]:
    """(3, h, w) and (1 or 2, h, w) inputs of the network."""
    if halved:
        image, channels = image[::2, ::2], halve_lidar(channels)
    return rgb_tensor(image, normalize=True), lidar_tensor(channels)


def stack_inputs(samples: list[Sample], architecture: Architecture) -> tuple[Tensor, Tensor]:
    """(B, 3, H, W) and (B, C, H, W) inputs of the network for a batch."""
    return (
        torch.stack([sample.rgb for sample in samples]),
        encode_depth(torch.stack([sample.lidar for sample in samples]), architecture),
    )


def _recolour(image: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Change brightness, contrast and saturation at random."""
    brightness, contrast, saturation = rng.uniform(1 - _JITTER, 1 + _JITTER, 3)
    values = image.astype(np.float32) * np.float32(brightness)
    mean = values.mean()
    values = (values - mean) * np.float32(contrast) + mean
    gray = values.mean(axis=2, keepdims=True)
    values = (values - gray) * np.float32(saturation) + gray
    return np.asarray(values.clip(0, 255), dtype=np.uint8)


def _mirror(
    image: NDArray[np.uint8], cloud: Array, view: View, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], Array]:
    """Exchange left and right, half of the time; the principal point stays in place."""
    if rng.random() < 0.5:  # noqa: PLR2004 - half of the time
        return image, cloud
    shift = 2 * view.centre_px[0] - (view.width - 1)  # the mirror image's centre back to cx
    move = np.array([[1.0, 0.0, shift], [0.0, 1.0, 0.0]])
    flipped = np.ascontiguousarray(image[:, ::-1])
    size = (view.width, view.height)
    image = np.asarray(cv2.warpAffine(flipped, move, size, borderMode=_BORDER), dtype=np.uint8)
    return image, cloud * np.array([-1.0, 1.0, 1.0, 1.0])


def _turn(
    image: NDArray[np.uint8], cloud: Array, view: View, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], Array]:
    """Rotate the camera about its centre, and warp the image accordingly."""
    angles = rng.uniform(-1, 1, 3) * [_TURN_DEG, _TURN_DEG, _ROLL_DEG]
    R = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    K = np.diag([*view.focal_px, 1.0])
    K[:2, 2] = view.centre_px
    homography = K @ R @ np.linalg.inv(K)
    size = (view.width, view.height)
    warped = cv2.warpPerspective(image, homography, size, borderMode=_BORDER)
    cloud = np.column_stack([cloud[:, :3] @ R.T, cloud[:, 3:]])
    return np.asarray(warped, dtype=np.uint8), cloud


def _draw_crop(
    shape: tuple[int, int], crop_px: tuple[int, int] | None, rng: np.random.Generator
) -> tuple[NDArray[np.int64], tuple[int, int]]:
    """Corner and size of a random crop; even, so that halving fits."""
    if crop_px is None:
        return np.zeros(2, np.int64), shape
    height, width = (min(size, most) for size, most in zip(shape, crop_px, strict=True))
    corner = [2 * int(rng.integers(0, (full - part) // 2 + 1))
              for full, part in zip(shape, (height, width), strict=True)]  # fmt: skip
    return np.array(corner, dtype=np.int64), (height, width)
