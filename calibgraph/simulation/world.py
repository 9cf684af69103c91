"""A world of painted triangles with sun and sky, and the rays cast into it.

Frame: z is up. Colours are linear, blue, green, red.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import needs_extra
from calibgraph.simulation.mesh import Mesh
from calibgraph.simulation.paints import paint_one
from factors.compiled import compiled

Floats = NDArray[np.float32]

_SUNLIGHT, _SKYLIGHT = (0.98, 1.05, 1.10), (0.50, 0.45, 0.40)
_HORIZON, _ZENITH, _HAZE_M = (0.85, 0.78, 0.70), (0.62, 0.36, 0.20), 500.0
_SHADOW_BIAS_M = 0.005
_TEXELS, _TEXEL_M, _NOISE_SLOPE, _GRAIN_M = 1024, 0.02, 1.1, 0.15


@dataclass(frozen=True, eq=False)
class World:
    """Triangles, paints and the sun.

    Attributes:
        scene: Open3D's ``RaycastingScene``.
        surfaces: (t, 14) per triangle: normal, (u, v) of a corner, their change to the other two,
            albedo, row of ``paints``.
        paints: (p, 11) see :class:`calibgraph.simulation.paints.Paint`.
        grain: (n, n) periodic noise of unit deviation.
        sun: (3,) unit vector towards the sun.
    """

    scene: Any
    surfaces: Floats
    paints: Array
    grain: Floats
    sun: Array


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays meet the world.

    Attributes:
        distance_m: (n,) along the unit ray; infinite where it meets nothing.
        triangle: (n,) index; -1 for none.
        within: (n, 2) barycentric coordinates of its second and third corner.
    """

    distance_m: Floats
    triangle: NDArray[np.int32]
    within: Floats


def build_world(mesh: Mesh, sun: Array, rng: np.random.Generator) -> World:
    """Prepare a mesh for rays.

    Args:
        mesh: all triangles.
        sun: (3,) unit vector towards the sun.
        rng: draws the grain of the paints.

    Raises:
        CalibrationError: if Open3D is missing.
    """
    open3d = _open3d()
    corners = mesh["corners_m"].astype(np.float32)
    order = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(corners.reshape(-1, 3)), open3d.core.Tensor(order))
    uv = mesh["uv_m"]
    table = [_normals(mesh["corners_m"]), uv[:, 0], uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]]
    paints, paint = np.unique(mesh["paint"], axis=0, return_inverse=True)
    return World(
        scene=scene,
        surfaces=np.column_stack([*table, mesh["albedo"], paint.ravel()]).astype(np.float32),
        paints=paints,
        grain=_noise_texture(rng),
        sun=sun,
    )


def cast(world: World, origin_m: Array, directions: Floats) -> Hits:
    """Cast rays from one place.

    Args:
        world: triangles that they may meet.
        origin_m: (3,) in the world.
        directions: (n, 3) unit vectors in the world.
    """
    origins = np.broadcast_to(origin_m.astype(np.float32), directions.shape)
    found = world.scene.cast_rays(_to_rays(origins, directions))
    triangle = found["primitive_ids"].numpy().view(np.int32)  # none is all ones, so -1
    return Hits(found["t_hit"].numpy(), triangle, found["primitive_uvs"].numpy())


def find_albedos(world: World, directions: Floats, hits: Hits) -> tuple[Array, Array]:
    """The painted surfaces that rays meet.

    Returns:
        (n, 4) albedos: blue, green, red, near infrared, and (n,) cosines of the angles of
        incidence; both are 0 where nothing is met.
    """
    return _albedos(  # type: ignore[no-any-return]
        directions, hits.triangle, hits.within, world.surfaces, world.paints, world.grain
    )


def shade(
    world: World, origin_m: Array, directions: Floats, hits: Hits, *, pixel_rad: float
) -> Floats:
    """The light along rays: sun with shadows, sky light and haze on surfaces, or the sky.

    Args:
        world: surfaces and sun.
        origin_m: (3,) of the rays.
        directions: (n, 3) unit vectors.
        hits: where the rays meet the world.
        pixel_rad: angular width of a ray; finer grain is averaged out.

    Returns:
        (n, 3) linear blue, green, red.
    """
    lit = _find_lit(world, origin_m, directions, hits)
    colour = np.empty((len(directions), 3), np.float32)
    _fill_sky(colour, directions)
    _fill_surfaces(
        colour, directions, hits.distance_m * np.float32(pixel_rad), hits.triangle, hits.within,
        lit, world.surfaces, world.paints, world.grain, world.sun,
    )  # fmt: skip
    _add_haze(colour, hits.distance_m)
    return colour


def _find_lit(world: World, origin_m: Array, directions: Floats, hits: Hits) -> NDArray[np.bool_]:
    """(n,) which hits are in direct sunlight."""
    starts, facing = _shadow_starts(
        origin_m, directions, hits.distance_m, hits.triangle, world.surfaces, world.sun
    )
    to_sun = np.broadcast_to(world.sun.astype(np.float32), starts.shape)
    lit = np.zeros(len(directions), np.bool_)
    lit[facing] = ~world.scene.test_occlusions(_to_rays(starts, to_sun)).numpy()
    return lit


def _to_rays(origins: Floats, directions: Floats) -> Any:
    rays = np.concatenate([origins, directions], axis=1)
    return _open3d().core.Tensor.from_numpy(rays)


INSTALL_LIBRARIES = "apt-get install libusb-1.0-0 libgl1 libegl1 libgomp1"
"""What Open3D needs on Debian and Ubuntu."""


def _open3d() -> Any:
    what = f"simulating sensors needs open3d, and on Debian or Ubuntu {INSTALL_LIBRARIES}"
    with needs_extra("simulation", what):
        import open3d
    return open3d


def _normals(corners: Array) -> Array:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.asarray(normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12))


def _noise_texture(rng: np.random.Generator) -> Floats:
    """Periodic pink noise of unit deviation."""
    white = np.fft.rfft2(rng.standard_normal((_TEXELS, _TEXELS)))
    frequency = np.hypot(np.fft.fftfreq(_TEXELS)[:, None], np.fft.rfftfreq(_TEXELS))
    texture = np.fft.irfft2(white / np.maximum(frequency, 4 / _TEXELS) ** _NOISE_SLOPE)
    return np.asarray(texture / texture.std(), dtype=np.float32)


@compiled()
def _shadow_starts(origin, directions, distance, triangle, surfaces, sun):  # type: ignore[no-untyped-def]
    """Points just off the surfaces that face the sun, and the indices of their hits."""
    starts = np.empty((len(triangle), 3), np.float32)
    facing = np.empty(len(triangle), np.int64)
    count = 0
    for i in range(len(triangle)):
        if triangle[i] < 0:
            continue
        x, y, z, _ = _facing_normal(surfaces[triangle[i]], directions[i])
        if x * sun[0] + y * sun[1] + z * sun[2] > 0:
            starts[count, 0] = origin[0] + distance[i] * directions[i, 0] + x * _SHADOW_BIAS_M
            starts[count, 1] = origin[1] + distance[i] * directions[i, 1] + y * _SHADOW_BIAS_M
            starts[count, 2] = origin[2] + distance[i] * directions[i, 2] + z * _SHADOW_BIAS_M
            facing[count] = i
            count += 1
    return starts[:count], facing[:count]


@compiled()
def _albedos(directions, triangle, within, surfaces, paints, grain):  # type: ignore[no-untyped-def]
    albedo = np.zeros((len(triangle), 4))
    incidence = np.zeros(len(triangle))
    for i in range(len(triangle)):
        if triangle[i] >= 0:
            row = surfaces[triangle[i]]
            albedo[i] = _albedo(row, paints, within[i], grain, 1.0)
            incidence[i] = _facing_normal(row, directions[i])[3]
    return albedo, incidence


@compiled()
def _fill_sky(colour, directions):  # type: ignore[no-untyped-def]
    """The sky in every direction, darker and bluer above."""
    for i in range(len(colour)):
        rise = min(max(2 * directions[i, 2], 0.0), 1.0)
        for c in range(3):
            colour[i, c] = _HORIZON[c] * (1 - rise) + _ZENITH[c] * rise


@compiled()
def _fill_surfaces(  # type: ignore[no-untyped-def]
    colour, directions, width, triangle, within, lit, surfaces, paints, grain, sun
):
    """Lit surfaces; ``width`` is the width of each ray at its hit."""
    for i in range(len(triangle)):
        if triangle[i] < 0:
            continue
        row = surfaces[triangle[i]]
        x, y, z, incidence = _facing_normal(row, directions[i])
        clear = 1 / (1 + width[i] / max(incidence, 0.05) / _GRAIN_M)
        albedo = _albedo(row, paints, within[i], grain, clear)
        sunny = (x * sun[0] + y * sun[1] + z * sun[2]) if lit[i] else 0.0
        for c in range(3):
            colour[i, c] = albedo[c] * (_SUNLIGHT[c] * sunny + _SKYLIGHT[c] * (0.7 + 0.3 * z))


@compiled()
def _add_haze(colour, distance):  # type: ignore[no-untyped-def]
    """Blend far surfaces into the colour of the horizon."""
    for i in range(len(colour)):
        if distance[i] < math.inf:
            clear = math.exp(-distance[i] / _HAZE_M)
            for c in range(3):
                colour[i, c] = colour[i, c] * clear + _HORIZON[c] * (1 - clear)


@compiled()
def _facing_normal(row, direction):  # type: ignore[no-untyped-def]
    """The normal on the side of the ray's origin, and the cosine of the angle of incidence."""
    along = row[0] * direction[0] + row[1] * direction[1] + row[2] * direction[2]
    sign = -1.0 if along > 0 else 1.0
    return sign * row[0], sign * row[1], sign * row[2], abs(along)


@compiled()
def _albedo(row, paints, within, grain, clear):  # type: ignore[no-untyped-def]
    """The painted albedo at a place on a triangle; ``clear`` scales the grain."""
    u = row[3] + within[0] * row[5] + within[1] * row[7]
    v = row[4] + within[0] * row[6] + within[1] * row[8]
    base = (float(row[9]), float(row[10]), float(row[11]), float(row[12]))
    light = clear * _noise(grain, u, v)
    return paint_one(paints[int(row[13])], float(u), float(v), light, base)


@compiled()
def _noise(grain, u, v):  # type: ignore[no-untyped-def]
    """The grain at a place, bilinear between texels."""
    x, y = u / _TEXEL_M, v / _TEXEL_M
    column, row = math.floor(x), math.floor(y)
    p, q = x - column, y - row
    i, j = int(column) % _TEXELS, int(row) % _TEXELS
    i_next, j_next = (i + 1) % _TEXELS, (j + 1) % _TEXELS
    low = grain[i, j] * (1 - p) + grain[i_next, j] * p
    high = grain[i, j_next] * (1 - p) + grain[i_next, j_next] * p
    return float(low * (1 - q) + high * q)
