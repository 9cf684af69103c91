"""Which points a camera sees, the nearest rays of a ray, and the windows made of them."""

import numpy as np
import pytest

import calibgraph
from calibgraph import Camera, Intrinsics, Rig
from calibgraph.matching.structure.directions import (
    find_in_view,
    find_visible,
    view_angles,
)
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.shift_scores import select_windows
from tests.conftest import KANNALA, SAMPLE, make_camera

T = np.array([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.2], [1.0, 0.0, 0.0, 0.3], [0, 0, 0, 1]])


def camera(model: str, distortion: list[float], cx: float = 320.0, cy: float = 200.0) -> Camera:
    return Camera(
        model=model,
        width_px=640,
        height_px=400,
        intrinsics_px=Intrinsics(fx=400.0, fy=390.0, cx=cx, cy=cy),
        distortion=distortion,
        T_camera_lidar=T,
    )


@pytest.mark.parametrize(
    "seen_by",
    [
        camera("pinhole", []),
        camera("pinhole", [], cx=20.0, cy=390.0),
        camera("pinhole", [], cx=-60.0),  # its axis lies outside of the image
        camera("pinhole", [-0.3, 0.1, 0.002, -0.003, 0.0], cx=200.0),
        camera("pinhole", [0.2, 0.05, 0.0, 0.0, 0.0]),
        camera("fisheye", [0.05, -0.01, 0.0, 0.0]),
    ],
)
def test_all_points_that_project_into_the_image_are_in_view(seen_by: Camera) -> None:
    points = np.random.default_rng(0).normal(size=(200_000, 3)) * [20.0, 20.0, 8.0]
    rows, angles, distance_m = find_in_view(points, seen_by)
    in_camera = points @ T[:3, :3].T + T[:3, 3]
    pixels, valid = seen_by.lens.project(in_camera)
    inside = ((pixels >= -0.5) & (pixels < [639.5, 399.5])).all(axis=1)
    np.testing.assert_array_equal(rows, np.flatnonzero(valid & inside))
    np.testing.assert_allclose(angles, view_angles(in_camera[rows]), atol=1e-12)
    np.testing.assert_allclose(distance_m, np.linalg.norm(in_camera[rows], axis=1), rtol=1e-12)


def test_background_behind_a_near_object_is_hidden() -> None:
    wall = np.column_stack(
        [*(a.ravel() for a in np.mgrid[-2:2:0.05, -2:2:0.05]), np.full(6400, 20.0)]
    )
    post = np.column_stack([np.zeros(100), np.linspace(-0.4, 0.4, 100), np.full(100, 4.0)])
    points = np.vstack([wall, post])
    visible = find_visible(view_angles(points), np.linalg.norm(points, axis=1), np.radians(0.5))
    assert visible[-100:].all()
    behind = (np.abs(wall[:, 0]) < 0.04) & (np.abs(wall[:, 1]) < 1.5)
    assert not visible[:-100][behind].any()
    assert visible[:-100][np.abs(wall[:, 0]) > 0.5].all()


def test_windows_come_from_clouds_with_and_without_intensity(truth: Rig) -> None:
    raw = calibgraph.load_dataset(SAMPLE, truth).frames[0].load_cloud()
    camera = truth.cameras["front_left"]
    cloud = PreparedCloud.from_points(raw)
    windows = select_windows(cloud, camera, LEVELS[3], max_windows=10_000)
    raw[:, 3] = np.nan
    cloud = PreparedCloud.from_points(raw)
    blind = select_windows(cloud, camera, LEVELS[3], max_windows=10_000)
    assert len(windows) > len(blind) > 100
    # Without intensities all ranks are equal: their mean rounds by 1e-16, which the column divides
    # by 1e-6 and weighs by 1e-15.
    assert np.abs(blind["basis"][:, :, 1]).max() < 1e-20
    # Columns are orthogonal to constants and to each other.
    for w in range(50):
        basis = windows["basis"][w, : windows["count"][w]].astype(float)
        np.testing.assert_allclose(basis.sum(axis=0), 0, atol=1e-4)
        gram = basis.T @ basis
        np.testing.assert_allclose(gram - np.diag(np.diag(gram)), 0, atol=1e-4)


def test_fisheyes_and_views_past_90_degrees_give_windows() -> None:
    raw = calibgraph.load_dataset(SAMPLE).frames[0].load_cloud()
    camera = Camera(
        model="fisheye",
        width_px=2600,
        height_px=2600,
        intrinsics_px=Intrinsics(fx=700.0, fy=700.0, cx=1300.0, cy=1300.0),
        distortion=KANNALA,
        T_camera_lidar=make_camera().T_camera_lidar,
    )
    cloud = PreparedCloud.from_points(raw)
    windows = select_windows(cloud, camera, LEVELS[2], max_windows=10_000)
    T = camera.T_camera_lidar
    z = (windows["rays_m"].reshape(-1, 3) @ T[:3, :3].T + T[:3, 3])[:, 2]
    assert z.min() < 0 < z.max()
    assert len(windows) > 100
