"""Images spoilt pixel by pixel: by night, sun, rain, dirt, a shutter, a lens or a lorry."""

import cv2
import numpy as np

from calibgraph import Camera

Array = np.ndarray
Rng = np.random.Generator


def random_sign(rng: Rng) -> float:
    """Plus or minus one."""
    return float(rng.choice([-1.0, 1.0]))


def blurred(image: Array, sigma: float) -> Array:
    """Gaussian."""
    return cv2.GaussianBlur(image, (0, 0), sigma)


def as_image(values: Array) -> Array:
    """Clipped to bytes."""
    return np.clip(values, 0, 255).astype(np.uint8)


def darken(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Night: little light and noise."""
    return as_image(0.06 * image.astype(np.float32) + rng.normal(0, 4, image.shape))


def dazzle(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """The low sun: a bright spot with a wide halo, which takes the contrast."""
    height, width = image.shape[:2]
    x, y = np.arange(width) / width - 0.55, np.arange(height) / height - 0.3
    halo = 500 * np.exp(-(x[None] ** 2 + y[:, None] ** 2) / (2 * 0.25**2))
    return as_image(0.5 * image + 60 + halo[..., None])


def wet(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Drops on the lens, at the same places in all frames: each shows a blurred neighbourhood."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    for x, y, size in np.random.default_rng(0).random((60, 3)):
        radius = int((0.01 + 0.04 * size) * width)
        cv2.circle(mask, (int(x * width), int(y * height)), radius, 255, -1)
    share = blurred(mask, width / 400)[..., None] / 255
    seen = blurred(np.roll(image, width // 20, axis=1), width / 100)
    return (share * seen + (1 - share) * image).astype(np.uint8)


def soil(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Dirt on the lens, at the same places in all frames, over half of the image."""
    height, width = image.shape[:2]
    field = cv2.resize(np.random.default_rng(1).random((5, 8)), (width, height))
    share = blurred((field > np.median(field)).astype(np.float32), width / 100)
    return (share[..., None] * 70 + (1 - share[..., None]) * image).astype(np.uint8)


def sheared_rows(image: Array, lean: float, middle: float) -> Array:
    """Rows moved aside by ``lean`` px each, about a middle row."""
    matrix = np.array([[1, lean, -lean * middle], [0, 1, 0]])
    return cv2.warpAffine(image, matrix, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT)


def roll_shutter(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """Rows exposed one after another while the vehicle turns, in each frame another way."""
    height, width = image.shape[:2]
    lean = random_sign(rng) * rng.uniform(0.01, 0.02) * width
    return sheared_rows(image, lean / height, height / 2)


def shear(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """A skew of 3 % of fx, which no lens of a rig has."""
    k = camera.intrinsics_px
    return sheared_rows(image, 0.03 * k.fx / k.fy, k.cy)


def pass_truck(image: Array, index: int, camera: Camera, rng: Rng) -> Array:
    """A truck fills half of the view, each frame elsewhere; the clouds do not have it."""
    height, width = image.shape[:2]
    colours = np.random.default_rng(2).integers(0, 255, (6, 9, 3), np.uint8)
    side = cv2.resize(colours, (width // 2, int(0.8 * height)))
    left, image = int(rng.uniform(0, 0.5) * width), image.copy()
    image[int(0.1 * height) :][: len(side), left : left + side.shape[1]] = side
    return image
