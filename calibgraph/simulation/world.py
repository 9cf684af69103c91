"""A world of painted triangles with sun and sky, and the rays cast into it.

Frame: z is up. Colours are linear, blue, green, red.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from calibgraph.arrays import Array
from calibgraph.errors import needs_extra
from calibgraph.simulation.mesh import Mesh
from calibgraph.simulation.paints import paint_one
from factors.compiled import compiled

Floats = NDArray[np.float32]

_SUNLIGHT, _SKYLIGHT = np.array([[0.98, 1.05, 1.10], [0.50, 0.45, 0.40]], np.float32)
_HORIZON, _ZENITH = np.array([[0.85, 0.78, 0.70], [0.62, 0.36, 0.20]], np.float32)
_HAZE_M = 500.0
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
    changes = np.ones(len(mesh), np.bool_)  # a solid is of one paint: sorting all rows takes longer
    changes[1:] = (mesh["paint"][1:] != mesh["paint"][:-1]).any(axis=1)
    paints, paint = np.unique(mesh["paint"][changes], axis=0, return_inverse=True)
    paint = paint.ravel()[np.cumsum(changes) - 1]
    return World(
        scene=scene,
        surfaces=np.column_stack([*table, mesh["albedo"], paint]).astype(np.float32),
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
    albedo, incidence = np.zeros((len(directions), 4)), np.zeros(len(directions))
    met = np.flatnonzero(hits.triangle >= 0)
    rows = world.surfaces[hits.triangle[met]]
    albedo[met] = _albedos(world, rows, hits.within[met], 1.0)
    incidence[met] = _facing_normals(rows, directions[met])[1]
    return albedo, incidence


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
    met = np.flatnonzero(hits.triangle >= 0)
    rows, rays, distance_m = (
        of.take(met, axis=0) for of in (world.surfaces[hits.triangle], directions, hits.distance_m)
    )
    normals, incidence = _facing_normals(rows, rays)
    sun, origin = world.sun.astype(np.float32), origin_m.astype(np.float32)
    sunny = np.maximum(normals @ sun, 0.0)
    facing = np.flatnonzero(sunny)
    starts = origin + distance_m[facing, None] * rays[facing] + _SHADOW_BIAS_M * normals[facing]
    shadows = world.scene.test_occlusions(_to_rays(starts, np.broadcast_to(sun, starts.shape)))
    sunny[facing[shadows.numpy()]] = 0.0
    clear = 1 / (1 + distance_m * np.float32(pixel_rad / _GRAIN_M) / np.maximum(incidence, 0.05))
    albedo = _albedos(world, rows, hits.within[met], clear)[:, :3]
    light = _SUNLIGHT * sunny[:, None] + _SKYLIGHT * (0.7 + 0.3 * normals[:, 2:])
    through = np.exp(-distance_m / _HAZE_M)[:, None]
    rise = np.clip(2 * directions[:, 2:], 0.0, 1.0)
    colour: Floats = _HORIZON + rise * (_ZENITH - _HORIZON)
    colour[met] = _HORIZON + through * (albedo * light - _HORIZON)
    return colour


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


def _facing_normals(rows: Floats, directions: Floats) -> tuple[Floats, Floats]:
    """The normals on the side of the rays' origin, and the cosines of the angles of incidence."""
    along = np.einsum("ni,ni->n", rows[:, :3], directions)
    return np.where(along[:, None] > 0, -rows[:, :3], rows[:, :3]), np.abs(along)


def _albedos(
    world: World, rows: Floats, within: Floats, clear: NDArray[np.floating] | float
) -> Floats:
    """(n, 4) the painted albedos at places on triangles; ``clear`` scales the grain."""
    uv = rows[:, 3:5] + within[:, :1] * rows[:, 5:7] + within[:, 1:] * rows[:, 7:9]
    texels = uv.T.astype(np.float64) / _TEXEL_M
    grain = clear * map_coordinates(world.grain, texels, order=1, mode="grid-wrap")
    albedo = np.empty((len(rows), 4), np.float32)
    _paint(world.paints, rows, uv, grain, albedo)
    return albedo


@compiled()
def _paint(paints, rows, uv, grain, albedo):  # type: ignore[no-untyped-def]
    for i in range(len(rows)):
        base = (float(rows[i, 9]), float(rows[i, 10]), float(rows[i, 11]), float(rows[i, 12]))
        paint, u, v = paints[int(rows[i, 13])], float(uv[i, 0]), float(uv[i, 1])
        albedo[i] = paint_one(paint, u, v, float(grain[i]), base)
