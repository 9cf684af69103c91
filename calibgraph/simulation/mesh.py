"""Painted triangles: the solids of a street, and ribbons of ground along a line."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.simulation.paints import Albedo, Paint
from calibgraph.simulation.solids import UV_AXES, Solid

_SIDES = 20
_SPLITS, _LEAF_SPLITS = 3, 4
_BOX_AXES = 0


TRIANGLE = np.dtype([
    ("corners_m", "f8", (3, 3)), ("uv_m", "f8", (3, 2)), ("albedo", "f8", 4), ("paint", "f8", 11)
])  # fmt: skip
"""A triangle: its corners in the world, their coordinates on the paint, the albedo under it, and
the numbers of the paint, see :meth:`.paints.Paint.packed`."""
Mesh = NDArray[np.void]
"""(t,) of TRIANGLE."""


def mesh_of(corners_m: Array, uv_m: Array, albedo: Albedo | Array, paint: Paint) -> Mesh:
    """The mesh of (t, 3, 3) corners and their (t, 3, 2) places on a paint."""
    mesh = np.empty(len(corners_m), TRIANGLE)
    mesh["corners_m"], mesh["uv_m"], mesh["albedo"] = corners_m, uv_m, albedo
    mesh["paint"] = paint.packed()
    return mesh


def mesh_of_solid(solid: Solid) -> Mesh:
    """The surface of a solid; round ones become many-sided."""
    unit = _unit_shape(solid.round_axes, bool(solid.bumps)).copy()
    if solid.bumps:
        unit *= 1 + solid.bumps * _lumps(unit, np.asarray(solid.base_m))[..., None]
    share = (unit[..., 2:] + 1) / 2
    unit[..., :2] *= 1 - share * (1 - np.asarray(solid.taper))
    own = unit * np.divide(solid.size_m, 2)
    normal = np.cross(own[:, 1] - own[:, 0], own[:, 2] - own[:, 0])
    axes = UV_AXES[np.abs(normal).argmax(axis=1)]
    uv = np.take_along_axis(own + np.divide(solid.size_m, 2), axes[:, None, :], axis=2)
    frame = solid.frame
    corners = unit @ frame[:3, :3].T + frame[:3, 3]
    return mesh_of(corners, uv + solid.uv_from_m, solid.albedo, solid.paint)


def ribbon(
    line_m: Array,
    along_m: Array,
    edges_m: Sequence[tuple[float, float]],
    *,
    albedo: Albedo,
    paint: Paint,
) -> Mesh:
    """A band of ground along a line, its v on the paint across, its u along the line.

    Args:
        line_m: (k, 4) points x, y of the line and a vector to its left.
        along_m: (k,) their distances along the line.
        edges_m: two edges, each its distance to the left of the line, in vectors, and its height.
        albedo: under the paint.
        paint: on the band; v is the distance to the left, plus the height.
    """
    rows = [np.column_stack([line_m[:, :2] + y * line_m[:, 2:], np.full(len(line_m), z)])
            for y, z in edges_m]  # fmt: skip
    places = [np.column_stack([along_m, np.full(len(along_m), y + z)]) for y, z in edges_m]
    return mesh_of(_quads(*rows), _quads(*places), albedo, paint)


def _quads(near: Array, far: Array) -> Array:
    """(2k-2, 3, n) two triangles between each pair of successive points of two rows (k, n)."""
    a, b, c, d = near[:-1], near[1:], far[1:], far[:-1]
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


@cache
def _unit_shape(round_axes: int, leafy: bool) -> Array:
    """(t, 3, 3) triangles of a shape of half extents 1 about the origin."""
    if round_axes == _BOX_AXES:
        return _unit_box()
    if round_axes == 2:  # noqa: PLR2004 - axes
        return _unit_cylinder()
    return _unit_sphere(_LEAF_SPLITS if leafy else _SPLITS)


def _unit_box() -> Array:
    square = np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])[[0, 1, 2, 0, 2, 3]]
    face = square.reshape(2, 3, 3)
    faces = [np.roll(sign * face, turn, axis=2) for turn in range(3) for sign in (1, -1)]
    return np.concatenate(faces)


def _unit_cylinder() -> Array:
    angle = np.linspace(0, 2 * np.pi, _SIDES + 1)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    low, high = (np.column_stack([circle, np.full(len(angle), z)]) for z in (-1.0, 1.0))
    lids = [
        np.stack([rim[:-1], rim[1:], np.tile([0.0, 0.0, z], (_SIDES, 1))], axis=1)
        for rim, z in ((low, -1.0), (high, 1.0))
    ]
    return np.concatenate([_quads(low, high), *lids])


def _unit_sphere(splits: int) -> Array:
    """An octahedron whose triangles are repeatedly split into four, on the unit sphere."""
    axes = np.eye(3)
    triangles = np.array([
        [x * axes[0], y * axes[1], z * axes[2]] for x in (1, -1) for y in (1, -1) for z in (1, -1)
    ])  # fmt: skip
    for _ in range(splits):
        a, b, c = triangles.swapaxes(0, 1)
        ab, bc, ca = ((p + q) / np.linalg.norm(p + q, axis=1, keepdims=True)
                      for p, q in ((a, b), (b, c), (c, a)))  # fmt: skip
        corners = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        triangles = np.concatenate([np.stack(three, axis=1) for three in corners])
    return triangles


def _lumps(unit: Array, seed: Array) -> Array:
    """Smooth noise of about unit deviation on a sphere (t, 3, 3), by a seed (3,)."""
    waves = np.array([[3, 1, 2], [-2, 4, 1], [1, -3, 4], [5, 2, -3], [-4, -5, 6], [7, -6, 3]])
    phases = unit @ waves.T * 1.7 + waves @ (seed * [1.3, 2.1, 0.7])
    return np.asarray(np.sin(phases).sum(axis=-1) / np.sqrt(len(waves) / 2))
