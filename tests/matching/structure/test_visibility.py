from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Camera, Intrinsics
from calibgraph.matching.structure.directions import view_angles
from calibgraph.matching.structure.visibility import (
    find_in_view,
)

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
