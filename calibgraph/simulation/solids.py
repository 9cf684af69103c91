"""The objects of a simulated street, composed of a few simple solids.

Frames: x along the street, y to the left of it, z up.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.simulation import paints
from calibgraph.simulation.paints import Albedo, Paint

STRETCH_M = 11.4
UNIT_X, UNIT_Y, UNIT_Z = np.eye(3)
UV_AXES = np.array([[1, 2], [0, 2], [0, 1]])
"""Which two axes are a surface's u and v, by the dominant axis of its normal."""
UNPAINTED: Albedo = ()
"""The colour is chosen by :func:`place`."""


def to_transform(xyz_m: Array | tuple[float, ...], *turns_deg: Array) -> Array:
    """(4, 4) transform of a position and rotation vectors in degrees; the last is applied first."""
    T = np.eye(4)
    for turn_deg in turns_deg:
        T[:3, :3] @= cv2.Rodrigues(np.deg2rad(turn_deg))[0]
    T[:3, 3] = xyz_m
    return T


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A box, an upright cylinder or an ellipsoid.

    Attributes:
        round_axes: number of leading axes that are round: 0, 2 or 3.
        base_m: (3,) centre of the underside.
        size_m: extents along its own axes.
        albedo: its colour.
        paint: over the albedo.
        yaw_deg: rotation about z.
        taper: extents of its top along x and y, relative to the underside.
        bumps: standard deviation of the radius of its surface, as a share, for leaves.
        uv_from_m: (u, v) of the surface's corner on the paint.
    """

    round_axes: int
    base_m: tuple[float, ...]
    size_m: tuple[float, float, float]
    albedo: Albedo
    paint: Paint = paints.PLAIN
    yaw_deg: float = 0.0
    taper: tuple[float, float] = (1.0, 1.0)
    bumps: float = 0.0
    uv_from_m: tuple[float, float] = (0.0, 0.0)

    @property
    def frame(self) -> Array:
        """(4, 4) from the shape of half extents 1 at the origin to the world."""
        half = np.divide(self.size_m, 2)
        return to_transform(np.add(self.base_m, half * UNIT_Z), self.yaw_deg * UNIT_Z) @ np.diag(
            (*half, 1)
        )


_Three = tuple[float, float, float]


def box(base_m: _Three, size_m: _Three, albedo: Albedo, paint: Paint = paints.PLAIN) -> Solid:
    """A box, its sides along the axes."""
    return Solid(round_axes=0, base_m=base_m, size_m=size_m, albedo=albedo, paint=paint)


def cylinder(base_m: _Three, size_m: _Three, albedo: Albedo, paint: Paint = paints.PLAIN) -> Solid:
    """An upright cylinder."""
    return Solid(round_axes=2, base_m=base_m, size_m=size_m, albedo=albedo, paint=paint)


def ellipsoid(base_m: _Three, size_m: _Three, albedo: Albedo, paint: Paint = paints.PLAIN) -> Solid:
    """An ellipsoid."""
    return Solid(round_axes=3, base_m=base_m, size_m=size_m, albedo=albedo, paint=paint)


def _wheels(reach_m: float) -> tuple[Solid, ...]:
    places = ((x, y) for x in (-reach_m, reach_m) for y in (-0.78, 0.78))
    return tuple(ellipsoid((*place, 0), (0.66, 0.36, 0.66), paints.RUBBER) for place in places)


CAR = (
    box((0, 0, 0.28), (4.3, 1.76, 0.64), UNPAINTED, paints.COACHWORK),
    box((-0.25, 0, 0.92), (2.35, 1.56, 0.50), paints.GLASS, paints.CABIN),
    box((-0.25, 0, 1.42), (2.40, 1.60, 0.06), UNPAINTED),
    *_wheels(1.35),
)
SLANTED_CAR = (  # a cabin that narrows towards the roof
    box((0, 0, 0.28), (4.3, 1.76, 0.58), UNPAINTED, paints.COACHWORK),
    replace(
        box((-0.3, 0, 0.86), (2.9, 1.64, 0.56), paints.GLASS, paints.CABIN), taper=(0.62, 0.82)
    ),
    box((-0.3, 0, 1.42), (1.8, 1.36, 0.05), UNPAINTED),
    *_wheels(1.35),
)
VAN = (
    box((-0.35, 0, 0.35), (4.1, 1.86, 1.95), UNPAINTED, paints.COACHWORK),
    box((2.15, 0, 0.35), (0.9, 1.8, 0.65), UNPAINTED),
    replace(box((1.95, 0, 1.0), (1.3, 1.78, 0.95), paints.GLASS, paints.CABIN), taper=(0.45, 0.94)),
    *_wheels(1.6),
)
FURNITURE = (  # of a stretch of pavement; y is from the kerb outwards
    cylinder((0, 0.8, 0), (0.34, 0.34, 2.8), paints.BARK),
    replace(ellipsoid((0, 0.8, 2.1), (2.8, 2.8, 3.2), paints.LEAVES, paints.LEAFY), bumps=0.09),
    cylinder((5, 0.7, 0), (0.16, 0.16, 6.5), paints.STEEL),
    box((5, -0.3, 6.4), (0.2, 2.0, 0.12), paints.STEEL),
    cylinder((-3, 0.6, 0), (0.09, 0.09, 2.7), paints.STEEL),
    box((-3, 0.6, 2), (0.12, 0.7, 0.7), paints.SIGN, paints.BOARD),
    cylinder((3, 0.9, 0), (0.6, 0.6, 1.2), UNPAINTED),
    cylinder((-1.5, 0.3, 0), (0.2, 0.2, 1.0), paints.TRIM),
)
TREE = (
    cylinder((0, 0, 0), (0.42, 0.42, 4.0), paints.BARK),
    *(
        replace(ellipsoid(base, size, paints.LEAVES, paints.LEAFY), bumps=0.12)
        for base, size in (
            ((0.2, 0.1, 2.6), (3.4, 3.2, 3.4)),
            ((-0.9, 0.7, 3.6), (2.6, 2.4, 2.6)),
            ((0.7, -0.8, 4.3), (2.4, 2.6, 2.4)),
        )
    ),
)
PERSON = (
    cylinder((0, 0, 0), (0.46, 0.46, 1.5), UNPAINTED, paints.LEAFY),
    ellipsoid((0, 0, 1.48), (0.22, 0.22, 0.28), paints.SKIN),
)
HEDGE = (
    box((0, 0.2, 0), (11, 0.06, 1.3), paints.BARK, paints.SLATS),
    box((0, 9.0, 0), (11, 1.2, 2.2), paints.LEAVES, paints.LEAFY),
)


def place(
    parts: Iterable[Solid], xy_m: tuple[float, float], *, yaw_deg: float, body: Albedo
) -> list[Solid]:
    """Place an object in the world."""
    T_world_parts = to_transform((*xy_m, 0), yaw_deg * UNIT_Z)
    return [
        replace(
            part,
            base_m=tuple(T_world_parts[:3, :3] @ np.asarray(part.base_m) + T_world_parts[:3, 3]),
            albedo=part.albedo or body,
            yaw_deg=yaw_deg + part.yaw_deg,
        )
        for part in parts
    ]
