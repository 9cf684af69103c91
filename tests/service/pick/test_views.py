from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibgraph.service.pick.views import snap_to_corner, visible_points
from tests.conftest import make_camera


def wall(distance_m: float, side_m: float) -> np.ndarray:
    y, z = np.mgrid[-side_m:side_m:60j, -side_m:side_m:60j]
    return np.column_stack([np.full(y.size, distance_m), y.ravel(), z.ravel()])


def test_points_behind_a_wall_are_hidden_and_beside_it_are_not() -> None:
    near, far = wall(5.0, 1.0), wall(20.0, 8.0)
    seen = visible_points(np.vstack([near, far]), make_camera())
    behind = np.abs(far[:, 1:]).max(axis=1) < 3.5  # the wall's shadow ends at 4 m
    rows = seen.rows[seen.rows >= len(near)] - len(near)
    assert not behind[rows].any()
    assert len(rows) > 100
    assert np.isin(np.arange(len(near)), seen.rows).all()


def test_the_answer_holds_rows_pixels_and_distances() -> None:
    camera = make_camera()
    seen = visible_points(wall(10.0, 1.0), camera)
    data, count = seen.to_bytes(), len(seen.rows)
    assert np.frombuffer(data, "<u4", 1)[0] == count
    assert (np.frombuffer(data, "<u4", count, 4) == seen.rows).all()
    floats = np.frombuffer(data, "<f4", 3 * count, 4 + 4 * count).reshape(3, count)
    assert np.allclose(floats[:2].T, seen.pixels_px, atol=1e-4)
    assert np.allclose(floats[2], seen.distance_m)


@pytest.mark.parametrize(("dx", "dy"), [(0, 0), (5, -3), (-4, 4)])
def test_a_pixel_snaps_to_the_corner_within_half_a_pixel(dx: int, dy: int) -> None:
    large = np.full((1600, 1600), 60, np.uint8)
    large[:803, :805] = 200
    large[803:, 805:] = 200
    gray = cv2.GaussianBlur(
        cv2.resize(large, (100, 100), interpolation=cv2.INTER_AREA), (3, 3), 0.7
    )
    truth = np.array([805 / 16 - 0.5, 803 / 16 - 0.5])
    found = snap_to_corner(gray, (round(truth[0]) + dx, round(truth[1]) + dy))
    assert found is not None
    assert np.hypot(*(found - truth)) < 0.5


def test_without_a_corner_there_is_none() -> None:
    assert snap_to_corner(np.full((100, 100), 7, np.uint8), (50, 50)) is None
    assert snap_to_corner(np.full((100, 100), 7, np.uint8), (-900.0, 4.0)) is None
