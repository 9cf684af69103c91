"""What a simulated road leads through: a street, a meadow, a motorway, a tunnel, a deck or a quay.

Few of them have the walls, corners and poles that a calibration lives on. Frames are those of
:mod:`calibgraph.simulation.street`; the lane at ``LANE_Y_M`` is free in all of them.
"""

from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from calibgraph.arrays import Array
from calibgraph.simulation.mesh import Mesh, mesh_of, mesh_of_solid, ribbon
from calibgraph.simulation.paints import (
    ASPHALT,
    BARK,
    GRASS,
    KERB_Y_M,
    LEAFY,
    LEAVES,
    PAVING,
    PLAIN,
    ROAD,
    SLABS,
    SLATS,
    STEEL,
    TRIM,
    Albedo,
    Paint,
)
from calibgraph.simulation.recording import SceneBuilder
from calibgraph.simulation.solids import Solid, box, cylinder
from calibgraph.simulation.street import (
    KINDS,
    Centreline,
    build_street,
    draw_cars,
    draw_colour,
    place_along,
)

Rng = np.random.Generator
Profile = Iterable[tuple[float, float]]
"""Distances to the left of the line, in widths of the street, and heights [m]."""

EARTH: Albedo = (0.07, 0.10, 0.14, 0.30)
CONCRETE: Albedo = (0.30, 0.31, 0.32, 0.36)
WATER: Albedo = (0.16, 0.14, 0.10, 0.01)
WORN = Paint(roughness=0.2)
_FIELDS = (GRASS, EARTH, (0.10, 0.30, 0.34, 0.55))
_VERGE_M, _SLOPE_M, _FAR_M = 5.0, 14.0, 90.0
_LEAF_M, _LEAVES_PER_M3 = 0.22, 14.0
_TUNNEL_M, _DECK_M, _DECK_HALF_M, _COLUMN_M = 5.2, 2.9, 30.0, 7.8


def build_meadow(line: Centreline, length_m: float, rng: Rng) -> Mesh:
    """A road without markings between grass slopes with bushes and trees, and one pole."""
    parts = list(_countryside(line, rng, WORN, trees=0.5))
    s, side = rng.uniform(10, 30), rng.choice([-1, 1])
    pole = place_along(
        line, [cylinder((0, 0, 0), (0.2, 0.2, 7.5), BARK)], s, side * 6.5, yaw_deg=0, body=BARK
    )
    return np.concatenate([*parts, *map(mesh_of_solid, pole)])


def build_motorway(line: Centreline, length_m: float, rng: Rng) -> Mesh:
    """Wide lanes with guard rails, some traffic, and fields on both sides."""
    rails: list[Solid] = []
    for side in (1, -1):
        for s in np.arange(line.along_m[0], line.along_m[-1], 4.0):
            post = cylinder((0, 0, 0), (0.12, 0.12, 0.75), STEEL)
            rail = box((2.0, 0, 0.5), (4.0, 0.06, 0.3), STEEL)
            rails += place_along(line, [post, rail], s, side * KERB_Y_M, yaw_deg=0, body=STEEL)
    cars = _traffic(line, length_m, rng)
    return np.concatenate(
        [*_countryside(line, rng, ROAD, trees=0.08), *map(mesh_of_solid, [*rails, *cars])]
    )


def build_tunnel(line: Centreline, length_m: float, rng: Rng) -> Mesh:
    """Plain walls and a ceiling with lamps; both ends are closed far away."""
    walls = [(KERB_Y_M, 0.0), (KERB_Y_M + 0.9, 0.25), (KERB_Y_M + 1.0, _TUNNEL_M)]
    parts = [mesh_of_solid(box((0, 0, -1.05), (4000, 4000, 1), EARTH, PLAIN)), *_road(line, ROAD)]
    for side in (1, -1):
        parts += _bands(line, [(side * y, z) for y, z in walls], CONCRETE, SLABS)
    parts += _bands(line, [(side * walls[-1][0], _TUNNEL_M) for side in (1, -1)], CONCRETE, PLAIN)
    solids = list(_traffic(line, length_m, rng))
    for s in np.arange(line.along_m[0], line.along_m[-1], rng.uniform(8, 16)):
        for side in (1, -1):
            lamp = box((0, 0, _TUNNEL_M - 0.3), (1.4, 0.3, 0.15), TRIM)
            solids += place_along(line, [lamp], s, side * 4.0, yaw_deg=0, body=TRIM)
    for s in line.along_m[[0, -1]]:
        wall = box((0, 0, 0), (1.0, 40.0, _TUNNEL_M + 1), CONCRETE)
        solids += place_along(line, [wall], s, 0, yaw_deg=0, body=CONCRETE)
    return np.concatenate([*parts, *map(mesh_of_solid, solids)])


def build_deck(line: Centreline, length_m: float, rng: Rng) -> Mesh:
    """A parking deck: floor, ceiling with beams, rows of columns, cars in most bays."""
    half = _DECK_HALF_M / line.layout.width
    parts = [
        *_bands(line, [(-half, 0.0), (half, 0.0)], CONCRETE, ROAD),
        *_bands(line, [(-half, _DECK_M), (half, _DECK_M)], CONCRETE, SLABS),
    ]
    for side in (1, -1):
        parts += _bands(line, [(side * half, 0.0), (side * half, _DECK_M)], CONCRETE, SLATS)
    solids: list[Solid] = []
    for s in np.arange(line.along_m[0], line.along_m[-1], _COLUMN_M):
        beam = box((0, 0, _DECK_M - 0.35), (0.3, 2 * _DECK_HALF_M, 0.35), CONCRETE)
        solids += place_along(line, [beam], s, 0, yaw_deg=0, body=CONCRETE)
        for y in np.arange(-2, 3) * 11.0 + 5.5:
            column = box((0, 0, 0), (0.45, 0.45, _DECK_M), CONCRETE, SLABS)
            solids += place_along(
                line, [column], s, y / line.layout.width, yaw_deg=0, body=CONCRETE
            )
    solids += draw_cars(line, length_m, rng)
    return np.concatenate([*parts, *map(mesh_of_solid, solids)])


def build_quay(line: Centreline, length_m: float, rng: Rng) -> Mesh:
    """Water on one side, which sends no beam back, a meadow on the other."""
    wet = float(rng.choice([-1.0, 1.0]))
    parts = [
        mesh_of_solid(box((0, 0, -2.0), (4000, 4000, 0.8), WATER, PLAIN)),
        *_road(line, WORN),
        *_bands(line, [(wet * KERB_Y_M, 0.0), (wet * (KERB_Y_M + 3), 0.1)], PAVING, SLABS),
        *_bands(line, [(wet * (KERB_Y_M + 3), 0.1), (wet * (KERB_Y_M + 3), -1.2)], CONCRETE, SLABS),
        *_slopes(line, -wet, rng),
        *_plants(line, -wet, rng, trees=0.3),
    ]
    rail: list[Solid] = []
    for s in np.arange(line.along_m[0], line.along_m[-1], 6.0):
        bollard = cylinder((0, 0, 0), (0.35, 0.35, 0.8), STEEL)
        rail += place_along(line, [bollard], s, wet * (KERB_Y_M + 2.4), yaw_deg=0, body=STEEL)
    return np.concatenate([*parts, *map(mesh_of_solid, rail)])


SURROUNDINGS: Mapping[str, SceneBuilder] = {
    "street": build_street,
    "meadow": build_meadow,
    "motorway": build_motorway,
    "tunnel": build_tunnel,
    "deck": build_deck,
    "quay": build_quay,
}


def _countryside(line: Centreline, rng: Rng, road: Paint, *, trees: float) -> Iterator[Mesh]:
    """Road, slopes and plants on both sides; ``trees`` is the chance of one every 8 m."""
    yield mesh_of_solid(box((0, 0, -4.05), (4000, 4000, 1), GRASS, LEAFY))
    yield from _road(line, road)
    for side in (1.0, -1.0):
        yield from _slopes(line, side, rng)
        yield from _plants(line, side, rng, trees=trees)


def _road(line: Centreline, paint: Paint) -> list[Mesh]:
    return _bands(line, [(KERB_Y_M, 0.0), (-KERB_Y_M, 0.0)], ASPHALT, paint)


def _slopes(line: Centreline, side: float, rng: Rng) -> Iterator[Mesh]:
    """A verge, a grass slope up or down, and fields that rise to a ridge far away."""
    top, ridge = rng.uniform(-1.5, 4.0), rng.uniform(4.0, 16.0)
    profile = [(KERB_Y_M, 0.0), (KERB_Y_M + _VERGE_M, -0.1), (KERB_Y_M + _SLOPE_M, top)]
    yield from _bands(line, [(side * y, z) for y, z in profile], GRASS, LEAFY)
    edges = np.linspace(KERB_Y_M + _SLOPE_M, _FAR_M, 5)
    heights = top + (ridge - top) * np.linspace(0, 1, 5) ** 2
    for (y, z), (y_next, z_next) in zip(
        zip(edges, heights, strict=True), zip(edges[1:], heights[1:], strict=False), strict=False
    ):
        albedo = _FIELDS[rng.integers(len(_FIELDS))]
        yield from _bands(line, [(side * y, z), (side * y_next, z_next)], albedo, LEAFY)


def _plants(line: Centreline, side: float, rng: Rng, *, trees: float) -> Iterator[Mesh]:
    """Bushes and trees, of single leaves: beams and views go into them."""
    for s in np.arange(line.along_m[0], line.along_m[-1], 8.0):
        xy, _ = line.at(s + rng.uniform(-3, 3), side * (KERB_Y_M + rng.uniform(2.0, 16.0)))
        if rng.random() < trees:
            trunk = cylinder((*xy, -1.0), (0.4, 0.4, 4.5), BARK)
            yield mesh_of_solid(trunk)
            yield _foliage((*xy, rng.uniform(3.0, 4.5)), rng.uniform(2.5, 5.0, 3), rng)
        else:
            yield _foliage((*xy, 0.7), rng.uniform((1.2, 1.2, 1.0), (4.0, 4.0, 2.4)), rng)


def _foliage(centre_m: tuple[float, float, float], size_m: Array, rng: Rng) -> Mesh:
    """Leaves of any direction within an ellipsoid, denser towards its middle."""
    count = int(np.prod(size_m) * _LEAVES_PER_M3)
    direction = rng.standard_normal((count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = centre_m + direction * size_m / 2 * np.sqrt(rng.random((count, 1)))
    corners = middle[:, None] + _LEAF_M * rng.standard_normal((count, 3, 3))
    light = np.exp(0.25 * rng.standard_normal((count, 1)))
    uv = rng.uniform(0, 9, (count, 1, 2)) + np.array([[0, 0], [_LEAF_M, 0], [0, _LEAF_M]])
    return mesh_of(corners, uv, np.asarray(LEAVES) * light, LEAFY)


def _traffic(line: Centreline, length_m: float, rng: Rng) -> Iterator[Solid]:
    """Cars ahead, behind and oncoming, far apart."""
    for s in np.arange(length_m + 20, line.along_m[-1], rng.uniform(20, 45)):
        kind = KINDS[rng.integers(len(KINDS))]
        yield from place_along(line, kind, s, -1.75, yaw_deg=0, body=draw_colour(rng))
    for s in np.arange(line.along_m[0], line.along_m[-1], rng.uniform(25, 60)):
        kind = KINDS[rng.integers(len(KINDS))]
        yield from place_along(line, kind, s, 1.75, yaw_deg=180, body=draw_colour(rng))


def _bands(line: Centreline, edges: Profile, albedo: Albedo, paint: Paint) -> list[Mesh]:
    """Bands between successive edges."""
    listed = list(edges)
    marks_m = line.along_m + line.layout.marks_from_m
    return [
        ribbon(line.with_left, marks_m, pair, albedo=albedo, paint=paint)
        for pair in zip(listed, listed[1:], strict=False)
    ]
