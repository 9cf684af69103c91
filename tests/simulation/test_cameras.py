"""Simulated cameras: the inverse of every lens, and the images."""

import numpy as np
import pytest

from calibgraph.model.geometry import invert
from calibgraph.simulation.cameras import camera_rays, trace_light
from calibgraph.simulation.mesh import mesh_of_solid
from calibgraph.simulation.solids import ellipsoid
from calibgraph.simulation.world import build_world
from tests.simulation.conftest import small_camera

pytestmark = pytest.mark.usefixtures("open3d")


@pytest.mark.parametrize(
    ("lens", "place_m"),
    [
        ("pinhole", (6.0, 2.0, 1.0)),
        ("radtan", (6.0, -4.2, -1.8)),
        ("radtan", (5.0, 3.2, 0.3)),
        ("fisheye", (4.0, 3.0, -1.0)),
        ("fisheye", (0.15, -4.0, -0.2)),  # 92 degrees off the axis
    ],
)
def test_a_ball_is_where_the_lens_projects_it(lens: str, place_m: tuple[float, ...]) -> None:
    camera = small_camera(lens)
    size = 0.04 * float(np.linalg.norm(place_m))
    rays, rng, sun = camera_rays(camera), np.random.default_rng(0), np.array([0.0, 0.0, 1.0])
    x, y, z = place_m
    black = (0.0, 0.0, 0.0, 0.0)
    ball = ellipsoid((x, y, z - size / 2), (size, size, size), black)
    far = ellipsoid((-900.0, 0.0, 900.0), (1.0, 1.0, 1.0), black)
    T_world_camera = invert(camera.T_camera_lidar)
    empty, full = (
        trace_light(
            build_world(np.concatenate([*map(mesh_of_solid, solids)]), sun, rng),
            rays,
            T_world_camera,
        )
        for solids in ((far,), (far, ball))
    )
    covered = np.maximum(empty - full, 0).sum(axis=2)
    v, u = (np.average(index, weights=covered) for index in np.indices(covered.shape))
    centre = camera.T_camera_lidar[:3, :3] @ place_m + camera.T_camera_lidar[:3, 3]
    expected = camera.lens.project(centre[None])[0][0]
    # A ball of angular radius r, at t off the axis, is an ellipse about f tan(t) (1 + tan(t)^2) r^2
    # from its centre's image: at most 150 * 0.8 * 1.6 * 0.02^2 = 0.08 px. Its 20 rim pixels are
    # covered by quarters: 0.02 px. Half a pixel's shift of the grid shows.
    assert np.count_nonzero(covered) > 5
    assert np.allclose([u, v], expected, atol=0.12)


def test_triangles_have_their_own_paints() -> None:
    mesh = mesh_of_solid(ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0)))
    mesh["paint"] = np.repeat([3.0, 1.0, 1.0, 2.0], -(-len(mesh) // 4))[: len(mesh), None]
    world = build_world(mesh, np.array([0.0, 0.0, 1.0]), np.random.default_rng(0))
    np.testing.assert_array_equal(world.paints[world.surfaces[:, -1].astype(int)], mesh["paint"])
