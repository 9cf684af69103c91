"""A procedural street that winds: ground with markings, houses, trees, poles, cars, people.

Frames: world x is ahead on average, y left, z up; a place in the street is its distance s along the
centreline and its distance y to the left of it.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.simulation import paints, solids
from calibgraph.simulation.mesh import Mesh, mesh_of_solid, ribbon
from calibgraph.simulation.paints import Albedo
from calibgraph.simulation.solids import Solid, box, cylinder, place

Rng = np.random.Generator

LANE_Y_M = -paints.LANE_M / 2
_PAVEMENT_Y_M, _GROUND_Y_M = 9.36, 24.0
_WINDING = ((0.32, 150.0), (0.10, 64.0))  # amplitude of the heading [rad], wavelength [m]
_STEP_M, _CLEAR_M = 1.0, 14.0
_BALCONIES, _GABLE = 0.4, 0.6
KINDS, _KIND_SHARES = (solids.CAR, solids.SLANTED_CAR, solids.VAN), (0.3, 0.55, 0.15)


@dataclass(frozen=True, kw_only=True)
class Layout:
    """The layout of a street; by default all streets have the same.

    Attributes:
        width: factor of all distances across: of lanes, kerbs, pavements, houses' fronts.
        winding: factor of how much it winds.
        spacing: factor of the distances between furniture along it.
        margin_m: its length behind the first stop and beyond the last.
        marks_from_m: where along it the markings of the road begin.
        setback_m: of the houses on the left and on the right, beyond the default.
        storeys: fewest and most.
        parked: share of the bays that are taken.
        oncoming: chance of an oncoming car every 12 m.
        gap: chance of a gap between houses.
        tree: chance of a tree in every stretch of pavement.
    """

    width: float = 1.0
    winding: float = 1.0
    spacing: float = 1.0
    margin_m: float = 70.0
    marks_from_m: float = 0.0
    setback_m: tuple[float, float] = (0.0, 0.0)
    storeys: tuple[int, int] = (2, 4)
    parked: float = 0.6
    oncoming: float = 0.35
    gap: float = 0.15
    tree: float = 0.45


def draw_layout(rng: Rng) -> Layout:
    """A layout between a lane with houses at its edge and a wide, green avenue."""
    lowest = int(rng.integers(1, 5))
    return Layout(
        width=float(np.exp(rng.uniform(np.log(0.7), np.log(1.6)))),
        winding=rng.uniform(0.0, 1.5),
        spacing=rng.uniform(0.7, 2.5),
        margin_m=rng.uniform(50, 100),
        marks_from_m=rng.uniform(0, 1000),
        setback_m=(rng.uniform(0, 10), rng.uniform(0, 10)),
        storeys=(lowest, lowest + int(rng.integers(1, 4))),
        parked=rng.uniform(0.0, 1.0),
        oncoming=rng.uniform(0.0, 0.6),
        gap=rng.uniform(0.0, 0.6),
        tree=rng.uniform(0.0, 0.9),
    )


@dataclass(frozen=True, eq=False)
class Centreline:
    """The centreline of a street, with its layout.

    Attributes:
        along_m: (k,) distances s along it, rising.
        xy_m: (k, 2) in the world.
        heading_rad: (k,) directions, unwrapped.
        layout: distances to the left of the line are of a street of the default width.
    """

    along_m: Array
    xy_m: Array
    heading_rad: Array
    layout: Layout

    def at(self, s_m: float, y_m: float) -> tuple[tuple[float, float], float]:
        """The place (x, y) [m] that is ``y_m`` to the left of the line, and the heading [deg]."""
        x, y = (np.interp(s_m, self.along_m, column) for column in self.xy_m.T)
        heading, left_m = np.interp(s_m, self.along_m, self.heading_rad), y_m * self.layout.width
        place_m = float(x - left_m * np.sin(heading)), float(y + left_m * np.cos(heading))
        return place_m, float(np.degrees(heading))

    @property
    def with_left(self) -> Array:
        """(k, 4) the places, and vectors to the left, whose length is the street's width."""
        left = np.stack([-np.sin(self.heading_rad), np.cos(self.heading_rad)])
        return np.column_stack([self.xy_m, *(self.layout.width * left)])


def winding_line(length_m: float, layout: Layout, rng: Rng) -> Centreline:
    """A line that winds about the x axis, from the layout's margin behind 0 to as much beyond."""
    along = np.arange(-layout.margin_m, length_m + layout.margin_m + _STEP_M, _STEP_M)
    phases = rng.uniform(0, 2 * np.pi, len(_WINDING))
    heading = layout.winding * sum(
        amplitude * np.sin(2 * np.pi * along / wavelength + phase)
        for (amplitude, wavelength), phase in zip(_WINDING, phases, strict=True)
    )
    steps = _STEP_M * np.column_stack([np.cos(heading), np.sin(heading)])
    xy = np.cumsum(steps, axis=0) - steps / 2
    xy -= xy[np.searchsorted(along, 0.0)]
    return Centreline(along, xy, np.asarray(heading), layout)


def build_street(line: Centreline, length_m: float, rng: Rng) -> Mesh:
    """Compose a street along a line; the lane at ``LANE_Y_M`` is free from 0 to ``length_m``."""
    parts = [*draw_cars(line, length_m, rng), *_backdrop(line, rng)]
    for side in (1, -1):
        parts += [*_houses(line, side, rng), *_roadside(line, side, rng)]
    return np.concatenate([*_ground(line), *map(mesh_of_solid, parts)])


def _ground(line: Centreline) -> Iterator[Mesh]:
    """Road, kerbs, pavements and grass, and a plain to the horizon."""
    yield mesh_of_solid(box((0, 0, -1.05), (4000, 4000, 1), paints.GRASS, paints.LEAFY))
    yield _band(line, ((paints.KERB_Y_M, 0), (-paints.KERB_Y_M, 0)), paints.ASPHALT, paints.ROAD)
    kerb, paving, lawn = (
        (paints.KERB_Y_M, 0.15),
        (paints.KERB_Y_M + 0.16, 0.15),
        (_PAVEMENT_Y_M, 0.1),
    )
    for side in (1, -1):
        for (y, z), (y_next, z_next), albedo, paint in (
            ((paints.KERB_Y_M, 0.0), kerb, paints.KERB, paints.PLAIN),
            (kerb, paving, paints.KERB, paints.PLAIN),
            (paving, (_PAVEMENT_Y_M, 0.15), paints.PAVING, paints.SLABS),
            ((_PAVEMENT_Y_M, 0.15), lawn, paints.KERB, paints.PLAIN),
            (lawn, (_GROUND_Y_M, 0.1), paints.GRASS, paints.LEAFY),
        ):
            yield _band(line, ((side * y, z), (side * y_next, z_next)), albedo, paint)


def _band(
    line: Centreline,
    edges_m: tuple[tuple[float, float], tuple[float, float]],
    albedo: Albedo,
    paint: paints.Paint,
) -> Mesh:
    marks_m = line.along_m + line.layout.marks_from_m
    return ribbon(line.with_left, marks_m, edges_m, albedo=albedo, paint=paint)


def place_along(
    line: Centreline, parts: Iterable[Solid], s_m: float, y_m: float, *, yaw_deg: float,
    body: Albedo,
) -> list[Solid]:  # fmt: skip
    """Place an object in the street, turned with it."""
    xy, heading_deg = line.at(s_m, y_m)
    return place(parts, xy, yaw_deg=heading_deg + yaw_deg, body=body)


def draw_colour(rng: Rng) -> Albedo:
    """The colour of a car or a house."""
    return paints.COLOURS[rng.integers(len(paints.COLOURS))]


def draw_cars(line: Centreline, length_m: float, rng: Rng) -> Iterator[Solid]:
    """Cars ahead, behind, oncoming, and parked on both sides."""
    first, last = line.along_m[[0, -1]]
    places = [(length_m + _CLEAR_M + 6, LANE_Y_M, 0.0), (-_CLEAR_M, LANE_Y_M, 0.0)]
    for s in np.arange(first, last, 12.0):
        if rng.random() < line.layout.oncoming:
            places.append((s + rng.uniform(-3, 3), -LANE_Y_M, 180.0))
    for side in (1, -1):
        for s in np.arange(first, last, 6.0):
            if rng.random() < line.layout.parked:
                places.append((s + 3 + rng.normal(0, 0.3), side * 4.75, 0.0))
    for s, y, yaw_deg in places:
        kind = KINDS[rng.choice(len(KINDS), p=_KIND_SHARES)]
        turned = yaw_deg + rng.normal(0, 2) + 180 * rng.integers(2)
        yield from place_along(line, kind, s, y, yaw_deg=turned, body=draw_colour(rng))


def _houses(line: Centreline, side: int, rng: Rng) -> Iterator[Solid]:
    """Rows of houses; in the gaps there are fences and hedges."""
    layout, s, turned = line.layout, line.along_m[0], 0.0 if side > 0 else 180.0
    (fewest, most), setback_m = layout.storeys, layout.setback_m[0 if side > 0 else 1]
    while s < line.along_m[-1]:
        bays, storeys = int(rng.integers(3, 6)), int(rng.integers(fewest, most + 1))
        front, middle = _PAVEMENT_Y_M + rng.uniform(0.3, 2.4), s + bays * paints.BAY_M / 2
        front += setback_m / layout.width
        if rng.random() < layout.gap:
            yield from place_along(
                line, solids.HEDGE, s + 5.5, side * _PAVEMENT_Y_M, yaw_deg=turned, body=paints.BARK
            )
            yield from place_along(
                line, solids.TREE, s + 4, side * 13, yaw_deg=rng.uniform(0, 360), body=paints.BARK
            )
            s += 11
            continue
        parts, body = list(_house(bays, storeys, rng)), draw_colour(rng)
        yield from place_along(line, parts, middle, side * front, yaw_deg=turned, body=body)
        s += bays * paints.BAY_M + (rng.uniform(0.5, 3) if rng.random() < layout.gap else 0)


def _house(bays: int, storeys: int, rng: Rng) -> Iterator[Solid]:
    """A house; its front is at y = 0, its middle at x = 0."""
    width, depth, height = bays * paints.BAY_M, 4 * paints.BAY_M, storeys * paints.STOREY_M
    walls = box((0, depth / 2, 0), (width, depth, height), solids.UNPAINTED, paints.FACADE)
    yield replace(walls, uv_from_m=(3 * paints.BAY_M * rng.integers(100), 0.0))
    if rng.random() < _GABLE:
        eaves = box(
            (0, depth / 2, height), (width + 0.4, depth + 0.8, 2.8), paints.TILES, paints.ROOFING
        )
        yield replace(eaves, taper=(0.97, 0.02))
    else:
        yield box((0, depth / 2, height), (width + 0.3, depth + 0.3, 0.5), paints.TRIM)
    yield box((rng.uniform(-0.3, 0.3) * width, depth / 2, height), (0.7, 0.9, 3.6), paints.BARK)
    yield cylinder((width / 2 - 0.1, -0.08, 0), (0.12, 0.12, height), paints.STEEL)
    yield box((paints.BAY_M * 1.5 - width / 2, -0.45, 0), (1.6, 0.9, 0.35), paints.PAVING)
    if rng.random() < _BALCONIES:
        yield from _balconies(bays, storeys, rng)


def _balconies(bays: int, storeys: int, rng: Rng) -> Iterator[Solid]:
    for bay, storey in np.ndindex(bays, storeys - 1):
        if rng.random() < _BALCONIES:
            x, z = (bay + 0.5 - bays / 2) * paints.BAY_M, (storey + 1) * paints.STOREY_M
            yield box((x, -0.55, z), (2.0, 1.1, 0.14), paints.TRIM)
            yield box((x, -1.07, z + 0.14), (2.0, 0.05, 0.95), paints.STEEL, paints.SLATS)


def _roadside(line: Centreline, side: int, rng: Rng) -> Iterator[Solid]:
    """Furniture of the pavements, and people on them."""
    turned = 0.0 if side > 0 else 180.0
    stretch_m = solids.STRETCH_M * line.layout.spacing
    for s in np.arange(line.along_m[0], line.along_m[-1], stretch_m) + rng.uniform(-1, 1):
        colour, body = draw_colour(rng), draw_colour(rng)
        yield from place_along(
            line, solids.FURNITURE, s, side * paints.KERB_Y_M, yaw_deg=turned, body=colour
        )
        person, person_y = s + rng.uniform(-5, 5), side * (paints.KERB_Y_M + rng.uniform(1.2, 2.8))
        yield from place_along(line, solids.PERSON, person, person_y, yaw_deg=0, body=body)
        if rng.random() < line.layout.tree:
            yaw, tree_y = rng.uniform(0, 360), side * (_PAVEMENT_Y_M - 0.5)
            yield from place_along(
                line, solids.TREE, s + 7.5, tree_y, yaw_deg=yaw, body=paints.BARK
            )


def _backdrop(line: Centreline, rng: Rng) -> Iterator[Solid]:
    """Blocks behind the houses, and across both ends of the street."""
    for side in (1, -1):
        x = line.xy_m[0, 0] - 40
        while x < line.xy_m[-1, 0] + 40:
            bays, storeys = int(rng.integers(4, 8)), int(rng.integers(3, 7))
            xy = x + bays * paints.BAY_M / 2, side * (48 + rng.uniform(-4, 4))
            body = draw_colour(rng)
            yield from place(_block(bays, 4, storeys), xy, yaw_deg=rng.normal(0, 4), body=body)
            x += bays * paints.BAY_M + rng.uniform(0, 8)
    for s in line.along_m[[0, -1]]:
        yield from place_along(line, _block(4, 16, 3), s, 0, yaw_deg=0, body=draw_colour(rng))


def _block(bays_along: int, bays_across: int, storeys: int) -> list[Solid]:
    size = bays_along * paints.BAY_M, bays_across * paints.BAY_M, storeys * paints.STOREY_M
    return [box((0, 0, 0), size, solids.UNPAINTED, paints.FACADE)]
