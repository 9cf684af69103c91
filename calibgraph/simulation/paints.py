"""The colours and patterns of a simulated street, as functions of a surface's own coordinates.

Albedos have four linear channels: blue, green, red, and near infrared, which the LiDAR sees.
"""

import math
from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array
from factors.compiled import compiled

Albedo = tuple[float, ...]

KERB_Y_M, LANE_M = 5.8, 3.5
BAY_M, STOREY_M = 2.6, 3.0
_CURTAINED, _WORN = 0.35, 1.9

ASPHALT, MARKING, PATCH = (0.1, 0.1, 0.1, 0.17), (0.62, 0.65, 0.66, 0.75), (0.05, 0.05, 0.05, 0.1)
PAVING, KERB, GRASS = (0.24, 0.27, 0.29, 0.38), (0.45, 0.47, 0.48, 0.55), (0.04, 0.17, 0.09, 0.62)
LEAVES, BARK, SIGN = (0.03, 0.13, 0.06, 0.68), (0.06, 0.09, 0.13, 0.36), (0.07, 0.06, 0.55, 0.97)
STEEL, RUBBER, GLASS = (0.30, 0.30, 0.29, 0.42), (0.03, 0.03, 0.03, 0.05), (0.16, 0.12, 0.09, 0.07)
TRIM, CURTAIN, SKIN = (0.70, 0.73, 0.75, 0.70), (0.38, 0.44, 0.50, 0.30), (0.25, 0.35, 0.50, 0.45)
TILES = (0.07, 0.10, 0.22, 0.34)
COLOURS = ((0.08, 0.13, 0.36, 0.44), (0.38, 0.55, 0.64, 0.62), (0.30, 0.31, 0.31, 0.35),
           (0.12, 0.36, 0.55, 0.58), (0.40, 0.20, 0.10, 0.28), (0.62, 0.66, 0.68, 0.72),
           (0.03, 0.03, 0.03, 0.06), (0.06, 0.05, 0.48, 0.55))  # fmt: skip

_LINED, _FACADE, _ROAD = 0, 1, 2
_NOTHING = (-1.0, -1.0, -1.0, -1.0)


@dataclass(frozen=True, kw_only=True)
class Paint:
    """Grained cells between lines of ink, and a pattern over them.

    Attributes:
        cell_m: size of a cell along u and v.
        line_m: width of the lines at each cell's lower edges.
        ink: albedo of the lines.
        roughness: standard deviation of the logarithm of the grain.
        pattern: over the cells: none, a facade, or a road.
        origin_m: (u, v) of the pattern's origin.
    """

    cell_m: tuple[float, float] = (9.0, 9.0)
    line_m: float = 0.0
    ink: Albedo = RUBBER
    roughness: float = 0.08
    pattern: int = _LINED
    origin_m: tuple[float, float] = (0.0, 0.0)

    def packed(self) -> Array:
        """(11,) all numbers, for the kernels."""
        return np.array(
            [self.pattern, *self.cell_m, self.line_m, *self.ink, self.roughness, *self.origin_m]
        )


PLAIN, LEAFY = Paint(), Paint(roughness=0.45)
COACHWORK = Paint(cell_m=(1.43, 0.9), line_m=0.03, roughness=0.02)
SLATS = Paint(cell_m=(0.4, 9.0), line_m=0.08, roughness=0.1)
CABIN = Paint(cell_m=(1.05, 0.48), line_m=0.07, ink=STEEL, roughness=0.02)
BOARD = Paint(cell_m=(9.0, 0.25), line_m=0.08, ink=TRIM, roughness=0.02)
SLABS = Paint(cell_m=(0.6, 0.6), line_m=0.025, ink=BARK, roughness=0.12)
ROOFING = Paint(cell_m=(0.32, 0.38), line_m=0.03, ink=RUBBER, roughness=0.15)
FACADE = Paint(cell_m=(9.0, 0.375), line_m=0.03, ink=BARK, pattern=_FACADE)
ROAD = Paint(roughness=0.2, pattern=_ROAD)


@compiled()
def paint_one(packed, u, v, grain, base):  # type: ignore[no-untyped-def]
    """The albedo of one point: blue, green, red, near infrared.

    Args:
        packed: (11,) the paint, see :meth:`Paint.packed`.
        u: coordinate on the surface; of a facade across, of a road along it.
        v: coordinate; of a facade up, of a road to the left.
        grain: noise of unit deviation.
        base: albedo under the pattern.
    """
    x, y = u - packed[9], v - packed[10]
    over = _NOTHING
    if packed[0] == _ROAD:
        over = _on_road(x, y, grain)
    elif packed[0] == _FACADE:
        over = _in_facade(x, y)
    if over[0] >= 0:
        return over
    lined = x % packed[1] < packed[3] or y % packed[2] < packed[3]
    light = math.exp(packed[8] * grain)
    if lined:
        return (packed[4] * light, packed[5] * light, packed[6] * light, packed[7] * light)
    return (base[0] * light, base[1] * light, base[2] * light, base[3] * light)


@compiled()
def _in_facade(x, y):  # type: ignore[no-untyped-def]
    """Framed windows in every bay, some with curtains, and a door in every third bay."""
    bay, storey = x // BAY_M, y // STOREY_M
    across, up = abs(x / BAY_M % 1 - 0.5), y / STOREY_M % 1
    is_door = storey == 0 and bay % 3 == 1
    height = abs(up - (0.30 if is_door else 0.56))
    if across >= 0.28 or height >= 0.28:
        return _NOTHING
    if across >= 0.25 or height >= 0.25:
        return TRIM
    if is_door:
        return BARK
    has_curtain = _scramble(bay, storey) < _CURTAINED and abs(up - 0.7) < 0.11
    return CURTAIN if has_curtain else GLASS


@compiled()
def _on_road(x, y, grain):  # type: ignore[no-untyped-def]
    """Markings that are not worn off, manhole covers, repairs."""
    if abs(y) < KERB_Y_M and grain < _WORN and _is_marked(x, y):
        return MARKING
    if math.hypot(x % 13 - 6, abs(y) - 2.4) < 0.32:
        return STEEL
    is_patch = _scramble(x // 4, y // 1.2) < 0.1 and abs(y) < KERB_Y_M
    return PATCH if is_patch else _NOTHING


@compiled()
def _is_marked(x, y):  # type: ignore[no-untyped-def]
    """Lane lines, parking bays, stop lines, crossings and arrows."""
    off_lane, block, arrow = abs(abs(y) - LANE_M / 2), x % 34, x % 17
    if abs(block - 16) < 1.5:  # a crossing has no other markings
        return abs(y % 1 - 0.25) < 0.25
    lane_line = (abs(y) < 0.07 and abs(x % 6 - 1.5) < 1.5) or abs(abs(y) - LANE_M) < 0.07
    bay = abs(abs(y) - 4.6) < 1.1 and abs(x % 6 - 0.06) < 0.06
    stop_line = abs(block - 13.2) < 0.2 and off_lane < 1.7
    shaft = abs(arrow - 5.1) < 1.1 and off_lane < 0.12
    head = abs(arrow - 6.8) < 0.6 and off_lane < 0.45 * (7.4 - arrow)
    return lane_line or bay or stop_line or shaft or head


@compiled()
def _scramble(i, j):  # type: ignore[no-untyped-def]
    """A pseudo-random number in [0, 1) for a cell."""
    return math.sin(i * 12.9898 + j * 78.233) * 43758.5453 % 1
