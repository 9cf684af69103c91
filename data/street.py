# SPDX-License-Identifier: Apache-2.0
"""A procedural street for the sample recording: its solids, their colours and textures.

Frames: x forward, y left, z up. Albedos have four linear channels: blue, green, red and near
infrared, which the LiDAR sees.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating[Any]]
Mask = npt.NDArray[np.bool_]
Image = npt.NDArray[np.uint8]
Points = npt.NDArray[np.float32]
Albedo = tuple[float, ...]
Paint = Callable[[Array, Array, Albedo], Array]  # (uv_m (N, 2), grain (N,), base) -> (N, 4)

GROUND_M, STREET_M, STRETCH_M = (240.0, 160.0), 92.0, 11.4
KERB_Y_M, PAVEMENT_M, LANE_M = 5.8, 3.4, 3.5
BAY_M, STOREY_M, CURTAINED, PARKED, WORN = 2.6, 3.0, 0.35, 0.6, 1.9
UNIT_X, UNIT_Y, UNIT_Z = np.eye(3)
UV_AXES = np.array([[1, 2], [0, 2], [0, 1]])  # texture axes by dominant axis of the normal

ASPHALT, MARKING, PATCH = (0.1, 0.1, 0.1, 0.17), (0.62, 0.65, 0.66, 0.75), (0.05, 0.05, 0.05, 0.1)
PAVING, KERB, GRASS = (0.24, 0.27, 0.29, 0.38), (0.45, 0.47, 0.48, 0.55), (0.04, 0.17, 0.09, 0.62)
LEAVES, BARK, SIGN = (0.03, 0.13, 0.06, 0.68), (0.06, 0.09, 0.13, 0.36), (0.07, 0.06, 0.55, 0.97)
STEEL, RUBBER, GLASS = (0.30, 0.30, 0.29, 0.42), (0.03, 0.03, 0.03, 0.05), (0.16, 0.12, 0.09, 0.07)
TRIM, CURTAIN, SKIN = (0.70, 0.73, 0.75, 0.70), (0.38, 0.44, 0.50, 0.30), (0.25, 0.35, 0.50, 0.45)
COLOURS = ((0.08, 0.13, 0.36, 0.44), (0.38, 0.55, 0.64, 0.62), (0.30, 0.31, 0.31, 0.35),
           (0.12, 0.36, 0.55, 0.58), (0.40, 0.20, 0.10, 0.28), (0.62, 0.66, 0.68, 0.72),
           (0.03, 0.03, 0.03, 0.06), (0.06, 0.05, 0.48, 0.55))  # fmt: skip
UNPAINTED: Albedo = ()  # takes its colour where it is placed


def lined(cell_m: tuple[float, float], line_m: float, ink: Albedo, roughness: float) -> Paint:
    """Make a paint of grained cells between lines of ink; `roughness` is the grain's deviation."""

    def paint(uv: Array, grain: Array, base: Albedo) -> Array:
        lines = (np.mod(uv, cell_m) < line_m).any(axis=1, keepdims=True)
        return np.asarray(np.where(lines, ink, base) * np.exp(roughness * grain[:, None]))

    return paint


PLAIN, LEAFY = (lined((9.0, 9.0), 0.0, RUBBER, rough) for rough in (0.08, 0.45))
COACHWORK, SLATS = lined((1.43, 0.9), 0.03, RUBBER, 0.02), lined((0.4, 9.0), 0.08, RUBBER, 0.1)
CABIN, BOARD = lined((1.05, 0.48), 0.07, STEEL, 0.02), lined((9.0, 0.25), 0.08, TRIM, 0.02)
SLABS = lined((0.6, 0.6), 0.025, BARK, 0.12)


def facade(uv: Array, grain: Array, base: Albedo) -> Array:
    """Paint courses of stone, framed windows in every bay and a door in every third one."""
    cell, (across, up) = uv // (BAY_M, STOREY_M), (uv / (BAY_M, STOREY_M) % 1).T
    albedo = lined((9.0, 0.375), 0.03, BARK, 0.08)(uv, grain, base)
    door = (cell[:, 1] == 0) & (cell[:, 0] % 3 == 1)
    middle = np.where(door, 0.30, 0.56)
    albedo[within(across, 0.5, 0.28) & within(up, middle, 0.28)] = TRIM
    opening = within(across, 0.5, 0.25) & within(up, middle, 0.25)
    albedo[opening] = GLASS
    albedo[opening & (scramble(cell) < CURTAINED) & within(up, 0.7, 0.11)] = CURTAIN
    albedo[opening & door] = BARK
    return albedo


def road(uv: Array, grain: Array, base: Albedo) -> Array:
    """Paint asphalt with repairs and covers, lane lines, bays, stop lines, crossings and arrows."""
    x, y = (uv - np.divide(GROUND_M, 2)).T
    off_lane, block, on_road = abs(abs(y) - LANE_M / 2), x % 34, within(y, 0, KERB_Y_M)
    albedo = PLAIN(uv, 2.5 * grain, base)
    albedo[(scramble(np.stack([x // 4, y // 1.2], axis=1)) < 1 / 10) & on_road] = PATCH
    albedo[within(np.hypot(x % 13 - 6, abs(y) - 2.4), 0, 0.32)] = STEEL
    line = within(y, 0, 0.07) & within(x % 6, 1.5, 1.5) | within(abs(y), LANE_M, 0.07)
    line |= within(abs(y), 4.6, 1.1) & within(x % 6, 0.06, 0.06)  # bays
    line |= within(block, 13.2, 0.2) & within(off_lane, 0, 1.7)  # stop lines
    line |= within(x % 17, 5.1, 1.1) & within(off_lane, 0, 0.12)  # arrows
    line |= within(x % 17, 6.8, 0.6) & within(off_lane, 0, 0.45 * (7.4 - x % 17))
    line = np.where(within(block, 16, 1.5), within(y % 1, 0.25, 0.25), line)
    albedo[line & on_road & (grain < WORN)] = MARKING
    return albedo


def within(value: Array, middle: float | Array, reach: float | Array) -> Mask:
    """Tell where values (N,) are nearer than `reach` to `middle`."""
    return np.asarray(abs(value - middle) < reach)


def scramble(cell: Array) -> Array:
    """Hash integer cells (N, 2) into [0, 1), shape (N,)."""
    return np.asarray(np.sin(cell @ (12.9898, 78.233)) * 43758.5453 % 1)


def pose(xyz_m: npt.ArrayLike, *turns_deg: npt.ArrayLike) -> Array:
    """Compose a transform (4, 4) from a position and rotation vectors in degrees, last first."""
    transform = np.eye(4)
    for turn_deg in turns_deg:
        transform[:3, :3] @= cv2.Rodrigues(np.deg2rad(turn_deg))[0]
    transform[:3, 3] = xyz_m
    return transform


class Solid(NamedTuple):
    """Box, upright cylinder or ellipsoid; `round_axes` counts its leading axes that are round."""

    round_axes: int
    base_m: npt.ArrayLike  # centre of the underside
    size_m: tuple[float, float, float]
    albedo: Albedo
    paint: Paint = PLAIN
    yaw_deg: float = 0.0

    @property
    def frame(self) -> Array:
        """Transform (4, 4) from the shape of half extents 1 at the origin to the world."""
        half = np.divide(self.size_m, 2)
        return pose(np.add(self.base_m, half * UNIT_Z), self.yaw_deg * UNIT_Z) @ np.diag((*half, 1))


BOX, CYLINDER, ELLIPSOID = 0, 2, 3
CAR = (Solid(BOX, (0, 0, 0.28), (4.3, 1.76, 0.64), UNPAINTED, COACHWORK),
       Solid(BOX, (-0.25, 0, 0.92), (2.35, 1.56, 0.50), GLASS, CABIN),
       Solid(BOX, (-0.25, 0, 1.42), (2.40, 1.60, 0.06), UNPAINTED),
       *(Solid(ELLIPSOID, (x, y, 0), (0.66, 0.36, 0.66), RUBBER)
         for x in (-1.35, 1.35) for y in (-0.78, 0.78)))  # fmt: skip
STRETCH = (  # of pavement with its furniture and the grass behind, from the kerb outwards along y
    Solid(BOX, (0, 0.08, 0), (STRETCH_M, 0.16, 0.15), KERB),
    Solid(BOX, (0, 0.16 + PAVEMENT_M / 2, 0), (STRETCH_M, PAVEMENT_M, 0.14), PAVING, SLABS),
    Solid(BOX, (0, 0.16 + PAVEMENT_M + 8, 0), (STRETCH_M, 16, 0.1), GRASS, LEAFY),
    Solid(CYLINDER, (0, 0.8, 0), (0.34, 0.34, 2.8), BARK),
    Solid(ELLIPSOID, (0, 0.8, 2.1), (2.8, 2.8, 3.2), LEAVES, LEAFY),
    Solid(CYLINDER, (5, 0.7, 0), (0.16, 0.16, 6.5), STEEL),
    Solid(BOX, (5, -0.3, 6.4), (0.2, 2.0, 0.12), STEEL),
    Solid(CYLINDER, (-3, 0.6, 0), (0.09, 0.09, 2.7), STEEL),
    Solid(BOX, (-3, 0.6, 2), (0.12, 0.7, 0.7), SIGN, BOARD),
    Solid(CYLINDER, (3, 0.9, 0), (0.6, 0.6, 1.2), UNPAINTED),
    Solid(CYLINDER, (-1.5, 0.3, 0), (0.2, 0.2, 1.0), TRIM),
)
PERSON = (Solid(CYLINDER, (0, 0, 0), (0.46, 0.46, 1.5), UNPAINTED, LEAFY),
          Solid(ELLIPSOID, (0, 0, 1.48), (0.22, 0.22, 0.28), SKIN))  # fmt: skip
HEDGE = (Solid(BOX, (0, 0.2, 0), (11, 0.06, 1.3), BARK, SLATS),
         Solid(BOX, (0, 9.0, 0), (11, 1.2, 2.2), LEAVES, LEAFY))  # fmt: skip


def place(parts: Iterable[Solid], x: float, y: float, yaw_deg: float, body: Albedo) -> list[Solid]:
    """Stand parts at (x, y) metres, turned about z; `body` colours the unpainted ones."""
    stand = pose((x, y, 0), yaw_deg * UNIT_Z)
    bases = [stand[:3, :3] @ np.asarray(part.base_m) + stand[:3, 3] for part in parts]
    return [
        part._replace(base_m=base, albedo=part.albedo or body, yaw_deg=yaw_deg)
        for part, base in zip(parts, bases, strict=True)
    ]


def street(rng: np.random.Generator) -> list[Solid]:
    """Compose the street: it runs along x from -16 m to 92 m and ends at a building."""
    solids = [Solid(BOX, (0, 0, -1), (*GROUND_M, 1), ASPHALT, road)]
    solids.append(Solid(BOX, (STREET_M + 12, 0, 0), (8, 16 * BAY_M, 9), COLOURS[1], facade))
    for x, y, yaw_deg in ((47.0, -1.7, 1), (60, -1.9, -2), (14, 1.8, 180), (33, 1.7, 178)):
        solids += place(CAR, x, y, yaw_deg, COLOURS[rng.integers(len(COLOURS))])
    for side, yaw_deg, gap_x in ((1, 0, 42.0), (-1, 180, 28.0)):
        solids += place(HEDGE, gap_x, side * (KERB_Y_M + PAVEMENT_M), yaw_deg, BARK)
        x = -16.0
        while x < STREET_M:
            size = BAY_M * rng.integers(3, 6), BAY_M * 4, STOREY_M * rng.integers(2, 5)
            y, middle = KERB_Y_M + PAVEMENT_M + rng.uniform(5.4, 6.8), x + size[0] / 2
            colour = COLOURS[rng.integers(len(COLOURS))]
            if abs(middle - gap_x) > size[0] / 2 + 4:
                solids.append(Solid(BOX, (middle, side * y, 0), size, colour, facade))
            x += size[0]
        for x in np.arange(-5, STREET_M, STRETCH_M) + rng.uniform(-1, 1):
            colour, person = COLOURS[rng.integers(len(COLOURS))], rng.uniform((-5, 1), (5, 2.5))
            solids += place(STRETCH, x, side * KERB_Y_M, yaw_deg, colour)
            solids += place(PERSON, x + person[0], side * (KERB_Y_M + person[1]), 0, colour)
        for x in np.arange(-9.0, STREET_M, 6.0)[rng.random(17) < PARKED]:
            colour = COLOURS[rng.integers(len(COLOURS))]
            solids += place(CAR, x + rng.normal(0, 0.3), side * 4.75, rng.normal(0, 2), colour)
    return solids
