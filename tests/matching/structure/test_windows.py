from __future__ import annotations

import itertools

import numpy as np

import calibgraph
from calibgraph import Camera, Intrinsics, Rig
from calibgraph.matching.structure.directions import sphere_angles
from calibgraph.matching.structure.prepared_cloud import PreparedCloud
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.shift_scores import select_windows
from calibgraph.matching.structure.window_table import WindowTable
from tests.conftest import KANNALA, SAMPLE, make_camera


def test_windows_come_from_clouds_with_and_without_intensity(truth: Rig) -> None:
    raw = calibgraph.load_dataset(SAMPLE, truth).frames[0].load_cloud()
    camera = truth.cameras["front_left"]
    cloud = PreparedCloud.from_points(raw)
    windows = select_windows(cloud, camera, LEVELS[3], max_windows=10_000)
    raw[:, 3] = np.nan
    cloud = PreparedCloud.from_points(raw)
    blind = select_windows(cloud, camera, LEVELS[3], max_windows=10_000)
    assert len(windows.counts) > len(blind.counts) > 100
    # Without intensities all ranks are equal: their mean rounds by 1e-16, which the column divides
    # by 1e-6 and weighs by 1e-15.
    assert np.abs(blind.basis[:, :, 1]).max() < 1e-20
    # Columns are orthogonal to constants and to each other.
    for w in range(50):
        basis = windows.basis[w, : windows.counts[w]].astype(float)
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
    z = (windows.rays_m.reshape(-1, 3) @ T[:3, :3].T + T[:3, 3])[:, 2]
    assert z.min() < 0 < z.max()
    assert len(windows.counts) > 100


def test_members_behind_a_silhouette_are_moved_to_it() -> None:
    """A post at 5 m before a wall at 20 m: no window has members at both distances."""
    angles = np.radians(np.arange(-6, 6, 0.2))
    rays = np.array([[1.0, np.tan(a), np.tan(e)] for a, e in itertools.product(angles, angles)])
    post = np.abs(rays[:, 1]) < np.tan(np.radians(1.0))
    rays *= np.where(post, 5.0, 20.0)[:, None]
    table = WindowTable(
        rays,
        np.ones(len(rays)),
        np.arange(len(rays)),
        sphere_angles(rays),
        spacing_rad=np.radians(0.2),
        stride_spacings=2.0,
        keep_linear=False,
    )
    everywhere = np.ones(len(rays), np.bool_)
    windows = table.cut(everywhere, everywhere, max_covered=0.0, max_windows=10_000)
    at_edge = ~windows.front.all(axis=1)
    assert np.count_nonzero(at_edge) > 20
    assert windows.rays_m[at_edge][..., 0].max() < 5.2
    along = windows.rays_m / np.linalg.norm(windows.rays_m, axis=2, keepdims=True)
    given = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    gap = np.linalg.norm(along.reshape(-1, 1, 3)[:500] - given, axis=2).min(axis=1)
    assert gap.max() < 1e-6  # along their own rays
