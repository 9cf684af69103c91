"""Kinds of ``data_cases`` whose images, clouds or lenses are changed, pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.accuracy.rig_changes import Rng, random_sign, to_transform, with_half_resolution
from benchmarks.accuracy.scenes import Array, Case, Scene, with_clouds, with_images
from calibgraph import Camera, Frame

Painter = Callable[[Array, int, Camera, Rng], Array]
"""An image, the number of its frame, its camera and a generator, to the changed image."""


def painted(scene: Scene, rng: Rng, paint: Painter, one_camera: bool) -> Case:
    """The images of one camera drawn at random, or of all, are changed."""
    names = list(scene.truth.cameras)
    chosen = [str(rng.choice(names))] if one_camera else names

    def paths(index: int, frame: Frame) -> dict[str, Path]:
        changed = dict(frame.image_paths)
        for name in set(chosen) & set(changed):
            camera = scene.truth.cameras[name]
            image = paint(frame.load_image(name, camera), index, camera, rng)
            changed[name] = scene.scratch / f"{name}_{index:06d}.png"
            cv2.imwrite(str(changed[name]), image)
        return changed

    return with_images(scene.data, paths), scene.guess(), {"changed": chosen}


def flip(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Mirrored left and right."""
    return np.ascontiguousarray(image[:, ::-1])


def turn_round(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Upside down: the camera is mounted so."""
    return np.ascontiguousarray(image[::-1, ::-1])


def darken(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Night: little light and noise."""
    dark = 0.06 * image.astype(np.float32) + rng.normal(0, 4, image.shape)
    return np.clip(dark, 0, 255).astype(np.uint8)


def dazzle(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """The low sun: a bright spot with a wide halo, which takes the contrast."""
    height, width = image.shape[:2]
    x, y = np.arange(width) / width - 0.55, np.arange(height) / height - 0.3
    halo = 500 * np.exp(-(x[None] ** 2 + y[:, None] ** 2) / (2 * 0.25**2))
    return np.clip(0.5 * image + 60 + halo[..., None], 0, 255).astype(np.uint8)


def wet(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Drops on the lens, at the same places in all frames: each shows a blurred neighbourhood."""
    height, width = image.shape[:2]
    drops = np.random.default_rng(0)
    mask = np.zeros((height, width), np.uint8)
    for x, y, size in drops.random((60, 3)):
        radius = int((0.01 + 0.04 * size) * width)
        cv2.circle(mask, (int(x * width), int(y * height)), radius, 255, -1)
    blurred = cv2.GaussianBlur(np.roll(image, width // 20, axis=1), (0, 0), width / 100)
    share = cv2.GaussianBlur(mask, (0, 0), width / 400)[..., None] / 255
    return (share * blurred + (1 - share) * image).astype(np.uint8)


def soil(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Dirt on the lens, at the same places in all frames, over half of the image."""
    height, width = image.shape[:2]
    field = cv2.resize(np.random.default_rng(1).random((5, 8)), (width, height))
    share = cv2.GaussianBlur((field > np.median(field)).astype(np.float32), (0, 0), width / 100)
    return (share[..., None] * 70 + (1 - share[..., None]) * image).astype(np.uint8)


def defocus(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Out of focus, but not beyond use."""
    return cv2.GaussianBlur(image, (0, 0), image.shape[1] / 300)


def roll_shutter(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Rows exposed one after another while the vehicle turns, in each frame another way."""
    height, width = image.shape[:2]
    lean = random_sign(rng) * rng.uniform(0.01, 0.02) * width
    matrix = np.array([[1, lean / height, -lean / 2], [0, 1, 0]])
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)


def shear(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """A skew of 3 % of fx, which no lens of a rig has."""
    k = camera.intrinsics_px
    lean = 0.03 * k.fx / k.fy
    matrix = np.array([[1, lean, -lean * k.cy], [0, 1, 0]])
    return cv2.warpAffine(image, matrix, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)


def pass_truck(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """A truck fills half of the view, each frame elsewhere; the clouds do not have it."""
    height, width = image.shape[:2]
    side = cv2.resize(
        np.random.default_rng(2).integers(0, 255, (6, 9, 3), np.uint8),
        (width // 2, int(0.8 * height)),
    )
    left = int(rng.uniform(0, 0.5) * width)
    image = image.copy()
    image[int(0.1 * height) :][: len(side), left : left + side.shape[1]] = side
    return image


def moved_halfway(scene: Scene, rng: Rng) -> Case:
    """One camera turns by 1 to 3 degrees after half of the frames: by a homography."""
    half = len(scene.data.frames) // 2
    step = to_transform(
        random_sign(rng) * rng.uniform(1, 3) * np.eye(3)[rng.integers(3)], np.zeros(3)
    )

    def turn(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
        if index < half:
            return image
        k = camera.intrinsics_px
        K = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
        warp = K @ step[:3, :3] @ np.linalg.inv(K)
        return cv2.warpPerspective(image, warp, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)

    return painted(scene, rng, turn, one_camera=True)


def frozen(scene: Scene, rng: Rng) -> Case:
    """One camera's images are all of one frame."""
    name = str(rng.choice(list(scene.truth.cameras)))
    first = scene.data.frames[0].image_paths[name]
    data = with_images(scene.data, lambda i, frame: {**frame.image_paths, name: first})
    return data, scene.guess(), {"changed": [name]}


def copies(scene: Scene, rng: Rng) -> Case:
    """Ten copies of one frame."""
    frame = scene.data.frames[int(rng.integers(len(scene.data.frames)))]
    frames = tuple(replace(frame, index=index) for index in range(10))
    return replace(scene.data, frames=frames), scene.guess(), {}


def parked(scene: Scene, rng: Rng) -> Case:
    """Ten frames of one place: copies of one frame with fresh noise in images and clouds."""
    data, guess, _ = copies(scene, rng)

    def shake(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
        return np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)

    still = replace(scene, data=data)
    still = replace(still, data=painted(still, rng, shake, one_camera=False)[0])
    noisy = with_clouds(still, lambda c: c + rng.normal(0, [0.01, 0.01, 0.01, 0], c.shape))
    return noisy, guess, {}


def blank_wall(scene: Scene, rng: Rng) -> Case:
    """A wall without features: flat images, clouds of one plane."""

    def flatten(cloud: Array) -> Array:
        away = cloud[:, :3] / np.linalg.norm(cloud[:, :3], axis=1, keepdims=True)
        flat = cloud[np.abs(away[:, 0]) > 0.1].copy()
        flat[:, :3] *= (8 / np.abs(flat[:, 0]))[:, None]
        flat[:, 3] = 0.3
        return flat

    def grey(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
        shade = np.linspace(100, 140, image.shape[1])[None, :, None]
        return np.clip(shade + rng.normal(0, 2, image.shape), 0, 255).astype(np.uint8)

    flat = replace(scene, data=with_clouds(scene, flatten))
    return painted(flat, rng, grey, one_camera=False)


def exchanged_axes(scene: Scene, rng: Rng) -> Case:
    """The clouds' x and y are exchanged."""
    return with_clouds(scene, lambda cloud: cloud[:, [1, 0, 2, 3]]), scene.guess(), {}


def scaled(scene: Scene, rng: Rng) -> Case:
    """The clouds' distances are 5 % too long or too short."""
    factor = 1 + 0.05 * random_sign(rng)
    data = with_clouds(scene, lambda cloud: cloud * [factor, factor, factor, 1])
    return data, scene.guess(), {"factor": factor}


def half_resolution(scene: Scene, rng: Rng) -> Case:
    """The intrinsics are those of images of half the size."""
    return scene.data, with_half_resolution(scene.guess()), {}


def distant_swap(scene: Scene, rng: Rng) -> Case:
    """The images of the first and the last camera are exchanged."""
    a, *_, b = scene.truth.cameras
    swap = {a: b, b: a}
    data = with_images(
        scene.data,
        lambda i, frame: {n: frame.image_paths[swap.get(n, n)] for n in frame.image_paths},
    )
    return data, scene.guess(), {}


KINDS: dict[str, Callable[[Scene, Rng], Case]] = {
    "flipped": partial(painted, paint=flip, one_camera=True),
    "upside_down": partial(painted, paint=turn_round, one_camera=True),
    "night": partial(painted, paint=darken, one_camera=False),
    "sun": partial(painted, paint=dazzle, one_camera=True),
    "wet_lens": partial(painted, paint=wet, one_camera=True),
    "dirty_lens": partial(painted, paint=soil, one_camera=True),
    "defocused": partial(painted, paint=defocus, one_camera=True),
    "rolling_shutter": partial(painted, paint=roll_shutter, one_camera=False),
    "sheared": partial(painted, paint=shear, one_camera=False),
    "truck": partial(painted, paint=pass_truck, one_camera=False),
    "moved_halfway": moved_halfway,
    "frozen": frozen,
    "copies": copies,
    "parked": parked,
    "blank_wall": blank_wall,
    "exchanged_axes": exchanged_axes,
    "scaled": scaled,
    "half_resolution": half_resolution,
    "distant_swap": distant_swap,
}
