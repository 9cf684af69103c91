# SPDX-License-Identifier: Apache-2.0
"""Simulate a LiDAR-camera rig driving along a procedural street and write the sample recording.

Frames: world and LiDAR are x forward, y left, z up; cameras are x right, y down, z forward.
Albedos have four linear channels: blue, green, red and near infrared, which the LiDAR sees.
"""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml  # type: ignore[import-untyped, unused-ignore]
from numpy.typing import NDArray
from street import street

from calibgraph.simulation.paints import painted
from calibgraph.simulation.solids import UNIT_X, UNIT_Y, UNIT_Z, UV_AXES, Solid, pose

Array = NDArray[np.floating[Any]]
Image, Points = NDArray[np.uint8], NDArray[np.float32]

WIDTH_PX, HEIGHT_PX, OVERSAMPLING, JPEG_QUALITY, GAMMA = 640, 360, 2, 85, 1 / 2.2
PIXEL_BLUR_PX, PIXEL_NOISE, BUNDLE = 0.45, 0.008, 80  # rays that are culled together
ELEVATION_DEG, AZIMUTH_DEG = np.linspace(-25, 10, 32), np.arange(-46, 114, 0.3)  # cameras' sector
MAX_RANGE_M, RANGE_NOISE_M, DROPOUT, INTENSITY_NOISE, RING_SPREAD = 80.0, 0.015, 0.02, 0.015, 0.05
FRAMES, STEP_M, LANE_Y_M, LIDAR_Z_M, RIG_ERROR_DEG, RIG_ERROR_M = 6, (4.3, 5.7), -1.75, 1.8, 2, 0.2
SUN = np.array([-0.55, -0.45, 0.70]) / np.linalg.norm([-0.55, -0.45, 0.70])  # towards the sun
SUNLIGHT, SKYLIGHT, SHADOW_BIAS_M = 1.05, 0.45, 0.005
HORIZON_BGR, ZENITH_BGR = np.array([0.85, 0.78, 0.70]), np.array([0.62, 0.36, 0.20])
NOISE_TEXELS, TEXEL_M, NOISE_SLOPE = 1024, 0.02, 1.1


def dot(a: Array, b: Array) -> Array:
    """Multiply vectors (N, K) with vectors (N, K) into scalars (N,)."""
    return np.asarray(np.einsum("ij,ij->i", a, b))


def enter(round_axes: int, origin: Array, direction: Array) -> Array:
    """Find ray parameters (N,) where rays (N, 3) enter the unit shape; inf where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / direction[:, round_axes:]
        middle, reach = -origin[:, round_axes:] * inverse, abs(inverse)
        near, far = list((middle - reach).T), list((middle + reach).T)
        if round_axes:
            o, d = origin[:, :round_axes], direction[:, :round_axes]
            a, b = dot(d, d), dot(o, d)
            root = np.sqrt(b * b - a * (dot(o, o) - 1))
            near, far = [*near, (-b - root) / a], [*far, (-b + root) / a]
    first, last = np.maximum.reduce(near), np.minimum.reduce(far)
    return np.asarray(np.where((first < last) & (first > 0), first, np.inf))


class World(NamedTuple):
    """Solids and the periodic noise texture that grains their paints."""

    solids: list[Solid]
    noise: Array

    def trace(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Find distances (N,) in metres and indices (N,) of solids first met; inf, -1 if none.

        Origins and unit directions are world (N, 3) or (1, 3). Bundles of successive rays far from
        a solid's bounding sphere skip its intersection test.
        """
        rays = np.stack(np.broadcast_arrays(origin, direction), axis=1)
        bundles = np.pad(rays, ((0, -len(rays) % BUNDLE), (0, 0), (0, 0)), "edge")
        bundles = bundles.reshape(-1, BUNDLE, 2, 3).astype(np.float32)  # ample, and fast
        mean = bundles.mean(axis=1, keepdims=True, dtype=np.float64)
        start, along = mean[:, 0].swapaxes(0, 1)
        spread = np.linalg.norm(bundles - mean.astype(np.float32), axis=-1).max(axis=1).T
        distance, index = np.full(bundles.shape[:2], np.inf), np.full(bundles.shape[:2], -1)
        for i, solid in enumerate(self.solids):
            frame = solid.frame.astype(np.float32)
            inverse = np.linalg.inv(frame)
            offset = frame[:3, 3] - start
            ahead, away2 = dot(offset, along), dot(offset, offset)
            reach = np.linalg.norm(frame[:3, :3]) + spread[0] + spread[1] * np.sqrt(away2)
            aside2 = away2 * dot(along, along) - ahead**2
            near = np.flatnonzero((aside2 < reach**2) & (ahead > -reach))
            local = bundles[near].reshape(-1, 3) @ inverse[:3, :3].T
            met = enter(solid.round_axes, local[::2] + inverse[:3, 3], local[1::2])
            bundle, ray = np.nonzero(met.reshape(-1, BUNDLE) < distance[near])
            distance[near[bundle], ray] = met[bundle * BUNDLE + ray]
            index[near[bundle], ray] = i
        return distance.ravel()[: len(rays)], index.ravel()[: len(rays)]

    def look(self, origin: Array, direction: Array) -> tuple[Array, Array, Array]:
        """Find distances (N,), unit normals (N, 3) and albedos (N, 4); inf, 0, 0 for the sky."""
        distance, index = self.trace(origin, direction)
        normal, albedo = np.zeros((len(index), 3)), np.zeros((len(index), 4))
        for i in np.unique(index[index >= 0]):
            solid, rays = self.solids[i], np.flatnonzero(index == i)
            half, inverse = np.divide(solid.size_m, 2), np.linalg.inv(solid.frame)
            hit = origin + distance[rays, None] * direction[rays]
            unit = hit @ inverse[:3, :3].T + inverse[:3, 3]
            reach, spun = abs(unit), unit[:, : solid.round_axes]
            reach[:, : solid.round_axes] = np.linalg.norm(spun, axis=1, keepdims=True)
            outward = np.where(reach == reach.max(axis=1, keepdims=True), unit, 0)
            normal[rays] = outward @ inverse[:3, :3]
            axes = UV_AXES[abs(outward / half).argmax(axis=1)]
            uv = np.take_along_axis((unit + 1) * half, axes, axis=1)
            u, v = (uv / TEXEL_M).astype(int).T % NOISE_TEXELS
            albedo[rays] = painted(solid.paint, uv, self.noise[u, v], solid.albedo)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        return distance, normal, albedo


class Camera(NamedTuple):
    """Intrinsics (fx, fy, cx, cy), distortion (k1, k2, p1, p2, k3) and mounting on the LiDAR."""

    intrinsics_px: tuple[float, float, float, float]
    distortion: tuple[float, ...]
    xyz_m: tuple[float, float, float]
    yaw_pitch_roll_deg: tuple[float, float, float]

    @property
    def T_lidar_camera(self) -> Array:
        """Transform (4, 4) from the camera's optical frame to the LiDAR frame."""
        yaw, pitch, roll = self.yaw_pitch_roll_deg
        turns = yaw * UNIT_Z, pitch * UNIT_Y, roll * UNIT_X
        return pose(self.xyz_m, *turns, -90 * UNIT_Z, -90 * UNIT_X)

    def rays(self) -> Array:
        """Cast unit rays (N, 3) in the optical frame through every subpixel, row by row."""
        v, u = np.indices((HEIGHT_PX * OVERSAMPLING, WIDTH_PX * OVERSAMPLING)).reshape(2, -1)
        pixels = (np.stack([u, v], axis=-1) + 0.5) / OVERSAMPLING - 0.5  # centre of the first: 0, 0
        fx, fy, cx, cy = self.intrinsics_px
        matrix, lens = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(self.distortion)
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
        plane = cv2.undistortPoints(pixels[:, None], matrix, lens, criteria=stop)
        rays = np.insert(plane[:, 0].astype(np.float64), 2, 1, axis=1)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


CAMERAS = {
    "front_left": Camera((481.3, 480.6, 318.9, 181.2), (), (0.42, 0.26, -0.34), (6, 4, 0.5)),
    "front_right": Camera((478.2, 478.9, 321.4, 178.6), (), (0.41, -0.25, -0.35), (-7, 3.5, -0.7)),
    "left": Camera((476.5, 477.1, 320.7, 180.9), (-0.14, 0.035, 0.0006, -0.0004, -0.003),
                   (0.08, 0.40, -0.30), (75, 5, 0.9)),
}  # fmt: skip


def render(world: World, rays: Array, T_world_camera: Array, rng: np.random.Generator) -> Image:
    """Picture the sunlit world, (height, width, BGR), along a camera's `rays` (N, 3)."""
    origin, direction = T_world_camera[None, :3, 3], rays @ T_world_camera[:3, :3].T
    distance, normal, albedo = world.look(origin, direction)
    rise, sun = np.clip(direction[:, 2:] * 2, 0, 1), np.maximum(normal @ SUN, 0)
    lit = np.flatnonzero(sun)
    start = origin + distance[lit, None] * direction[lit] + SHADOW_BIAS_M * normal[lit]
    sun[lit] *= world.trace(start, SUN[None])[1] < 0
    light = SUNLIGHT * sun + SKYLIGHT * (0.7 + 0.3 * normal[:, 2])
    sky = HORIZON_BGR * (1 - rise) + ZENITH_BGR * rise
    colour = np.where(np.isfinite(distance)[:, None], albedo[:, :3] * light[:, None], sky)
    fine = colour.reshape(HEIGHT_PX * OVERSAMPLING, WIDTH_PX * OVERSAMPLING, 3)
    coarse = cv2.resize(fine, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA)
    image = np.asarray(cv2.GaussianBlur(coarse, (0, 0), PIXEL_BLUR_PX) ** GAMMA)
    image += rng.normal(0, PIXEL_NOISE, image.shape)
    return (image.clip(0, 1) * 255).round().astype(np.uint8)


def scan(world: World, T_world_lidar: Array, ring_gain: Array, rng: np.random.Generator) -> Points:
    """Scan points (N, 4), shuffled: x, y, z in LiDAR-frame metres and intensity in [0, 1]."""
    azimuth, elevation = np.meshgrid(np.deg2rad(AZIMUTH_DEG), np.deg2rad(ELEVATION_DEG))
    flat = np.cos(elevation)
    beams = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    rays, gain = beams.reshape(-1, 3), np.repeat(ring_gain, len(AZIMUTH_DEG))
    direction = rays @ T_world_lidar[:3, :3].T
    distance, normal, albedo = world.look(T_world_lidar[None, :3, 3], direction)
    incidence = abs(dot(normal, direction))
    intensity = albedo[:, 3] * (0.55 + 0.45 * incidence) * gain
    intensity += rng.normal(0, INTENSITY_NOISE, len(rays))
    distance += rng.normal(0, RANGE_NOISE_M, len(rays))
    kept = np.flatnonzero((distance < MAX_RANGE_M) & (rng.random(len(rays)) > DROPOUT))
    points = np.column_stack([rays * distance[:, None], intensity.clip(0, 1)])
    return np.asarray(points[rng.permutation(kept)], dtype=np.float32)


def rig_error(rng: np.random.Generator) -> Array:
    """Draw a transform (4, 4) of fixed angle and length about and along random directions."""
    axis, shift = (vector / np.linalg.norm(vector) for vector in rng.standard_normal((2, 3)))
    return pose(shift * RIG_ERROR_M, axis * RIG_ERROR_DEG)


def write_rig(path: Path, deltas: Iterable[Array]) -> None:
    """Write the rig with every T_camera_lidar premultiplied by its delta."""
    cameras: dict[str, Any] = {}
    for (name, camera), delta in zip(CAMERAS.items(), deltas, strict=True):
        intrinsics = dict(zip(("fx", "fy", "cx", "cy"), camera.intrinsics_px, strict=True))
        cameras[name] = {
            "model": "pinhole",
            "width_px": WIDTH_PX,
            "height_px": HEIGHT_PX,
            "intrinsics_px": intrinsics,
            "distortion": list(camera.distortion),
            "T_camera_lidar": (delta @ np.linalg.inv(camera.T_lidar_camera)).tolist(),
        }
    rig = {"format": "calibgraph-rig/1", "lidar": "lidar", "cameras": cameras}
    path.write_text(yaml.safe_dump(rig, sort_keys=False, default_flow_style=None, width=100))


def noise_texture(rng: np.random.Generator) -> Array:
    """Draw a periodic square texture (NOISE_TEXELS,) * 2 of pink noise of unit deviation."""
    white = np.fft.rfft2(rng.standard_normal((NOISE_TEXELS, NOISE_TEXELS)))
    frequency = np.hypot(np.fft.fftfreq(NOISE_TEXELS)[:, None], np.fft.rfftfreq(NOISE_TEXELS))
    texture = np.fft.irfft2(white / np.maximum(frequency, 4 / NOISE_TEXELS) ** NOISE_SLOPE)
    return np.asarray(texture / texture.std())


def generate(out: Path, seed: int, frames: int = FRAMES) -> None:
    """Write the whole recording under `out`."""
    rng = np.random.default_rng(seed)
    for folder in ("lidar", *(f"cameras/{name}" for name in CAMERAS)):
        (out / folder).mkdir(parents=True, exist_ok=True)
    write_rig(out / "reference.yaml", [np.eye(4) for _ in CAMERAS])
    write_rig(out / "rig.yaml", [rig_error(rng) for _ in CAMERAS])
    world, x = World(street(rng), noise_texture(rng)), 0.0
    ring_gain = 1 + RING_SPREAD * rng.standard_normal(len(ELEVATION_DEG))
    rays = {name: camera.rays() for name, camera in CAMERAS.items()}
    for frame in range(frames):
        place_m = (x, LANE_Y_M + rng.normal(0, 0.2), LIDAR_Z_M)
        T_world_lidar = pose(place_m, rng.normal(0, (0.4, 0.4, 2)))
        np.save(out / f"lidar/{frame:06d}.npy", scan(world, T_world_lidar, ring_gain, rng))
        for name, camera in CAMERAS.items():
            image = render(world, rays[name], T_world_lidar @ camera.T_lidar_camera, rng)
            path = str(out / f"cameras/{name}/{frame:06d}.jpg")
            cv2.imwrite(path, image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        x += rng.uniform(*STEP_M)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "sample")
    parser.add_argument("--seed", type=int, default=7)
    blocked = "the ninth may stand in the car ahead"
    parser.add_argument("--frames", type=int, default=FRAMES, choices=range(1, 9), help=blocked)
    arguments = parser.parse_args()
    generate(arguments.out, arguments.seed, arguments.frames)
