"""Vehicles with several LiDARs in places made of boxes, ray by ray: the truth is exact."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import transform

HEIGHT_M = 1.8  # of the base LiDAR over the road
MOUNTS = {
    "top": transform(np.eye(3)),
    "front": transform(
        Rotation.from_euler("zyx", [4.0, 25.0, 1.0], degrees=True), [2.2, 0.1, -1.0]
    ),
    "left": transform(
        Rotation.from_euler("zyx", [88.0, 38.0, 0.0], degrees=True), [0.4, 0.8, -0.5]
    ),
}
"""(4, 4) T_base_lidar; the base is ``top``."""


ALL_AROUND_DEG = np.arange(-180.0, 180.0, 1.0)


def displaced(T: Array, seed: int, deg: float, metres: float) -> Array:
    """A pose turned and shifted by so much, in random directions."""
    turn, shift = np.random.default_rng(seed).normal(size=(2, 3))
    turn, shift = (each / np.linalg.norm(each) for each in (turn, shift))
    R = Rotation.from_rotvec(np.radians(deg) * turn).as_matrix()
    return transform(R @ T[:3, :3], T[:3, 3] + metres * shift)


def draw_place(
    rng: np.random.Generator, *, boxes: int = 14, fronts: bool = True, ahead_m: float = 0.0
) -> Array:
    """(n, 2, 3) corners of the boxes of a place [m]: houses, cars; x ahead, z over the road."""
    found = []
    for side in (-1.0, 1.0) if fronts else ():
        x = -45.0
        while x < 45.0 + ahead_m:  # houses of other depths along the road
            length, back = rng.uniform(6, 14), rng.uniform(7, 13)
            found.append(
                [[x, side * back, 0.0], [x + length, side * (back + 8.0), rng.uniform(5, 12)]]
            )
            x += length + rng.uniform(0, 5)
    for _ in range(boxes):
        low = np.array(
            [rng.uniform(-30, 30 + ahead_m), rng.choice([-1, 1]) * rng.uniform(3.5, 6.5), 0.0]
        )
        found.append([low, low + rng.uniform([0.4, 0.4, 0.8], [4.5, 2.0, 2.5])])
    return np.sort(np.array(found, dtype=np.float64).reshape(-1, 2, 3), axis=1)


def flat_street() -> Array:
    """Two endless walls: nothing across the road."""
    return np.array([[[-500.0, s * 9.0 - 1.0, 0.0], [500.0, s * 9.0 + 1.0, 9.0]] for s in (-1, 1)])


def scan(boxes: Array, T_road_lidar: Array, rng: np.random.Generator, *, beams: int = 20,
         noise_m: float = 0.015, azimuths_deg: Array = ALL_AROUND_DEG) -> Array:  # fmt: skip
    """(n, 3) what a spinning LiDAR measures of boxes and the ground, in its frame."""
    azimuth, elevation = np.meshgrid(
        np.radians(azimuths_deg), np.radians(np.linspace(-28.0, 14.0, beams))
    )
    flat = np.cos(elevation)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)
    rays = rays.reshape(-1, 3)
    origin, towards = T_road_lidar[:3, 3], rays @ T_road_lidar[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(towards[:, 2] < 0, -origin[2] / towards[:, 2], np.inf)
        for low, high in boxes:
            ends = (np.stack([low, high]) - origin)[:, None] / towards
            near, far = ends.min(axis=0).max(axis=1), ends.max(axis=0).min(axis=1)
            hit = (near < far) & (near > 0)
            distance = np.where(hit, np.minimum(distance, near), distance)
    seen = (distance > 0.8) & (distance < 80.0)
    distance = distance + rng.normal(0.0, noise_m, len(distance))
    return np.asarray(rays[seen] * distance[seen, None])


def record(
    seed: int, *, places: int = 4, mounts: Mapping[str, Array] = MOUNTS, street: bool = False,
    moved: Mapping[str, Array] | None = None, scatter: tuple[float, float] = (0.0, 0.0),
    beams: int = 20,
) -> dict[str, list[Array]]:  # fmt: skip
    """Clouds of each LiDAR at each place; of places from the half on, LiDARs stand as ``moved``.

    At each place they are displaced by ``scatter`` [rad, m] per axis, as clouds of other times are.
    """
    rng = np.random.default_rng(seed)
    clouds: dict[str, list[Array]] = {name: [] for name in mounts}
    for place in range(places):
        boxes = flat_street() if street else draw_place(rng)
        at = transform(
            Rotation.from_euler("zyx", rng.normal(0.0, [5.0, 0.5, 0.5]), degrees=True),
            [rng.uniform(-4, 4), rng.uniform(-1, 1), HEIGHT_M],
        )
        if street:
            at[:3, :3] = np.eye(3)
        of_place = {**mounts, **(moved or {})} if place >= places / 2 else mounts
        for name, T in of_place.items():
            here = T.copy()
            if name != "top":
                here[:3, :3] = (
                    Rotation.from_rotvec(rng.normal(0, scatter[0], 3)).as_matrix() @ T[:3, :3]
                )
                here[:3, 3] += rng.normal(0, scatter[1], 3)
            clouds[name].append(scan(boxes, at @ here, rng, beams=beams))
    return clouds
