"""Lenses that see all round equal the formulas of their papers, written out."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

from factors import Lens, ProjectionBlock, block_factor, projection_factor, unproject

Array = NDArray[np.float64]

K = {"fx": 412.0, "fy": 409.0, "cx": 640.5, "cy": 479.0}
DISTORTION = (-0.06, 0.02, 0.001, -0.002)
XI = [0.0, 0.7, 1.0, 1.6, 2.8]
WIDTH, HEIGHT = 2000, 1000
PANORAMA = Lens.equirectangular(
    fx=WIDTH / (2 * np.pi), fy=HEIGHT / np.pi, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2
)


def points_all_round(count: int = 2000, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    rays = rng.standard_normal((count, 3))
    rays *= np.exp(rng.uniform(-1, 4, (count, 1))) / np.linalg.norm(rays, axis=1, keepdims=True)
    return rays


def unified_lens(xi: float) -> Lens:
    return Lens.omnidirectional(**K, distortion=(xi, *DISTORTION))


def mei_pixel(xi: float, point: Array) -> tuple[float, float]:
    """Mei and Rives (2007), step by step; distortion as in cv2.omnidir.projectPoints."""
    X = point / np.sqrt(point @ point)
    m = np.array([X[0] / (X[2] + xi), X[1] / (X[2] + xi)])
    k1, k2, p1, p2 = DISTORTION
    r = np.sqrt(m[0] ** 2 + m[1] ** 2)
    L = 1 + k1 * r**2 + k2 * r**4
    x = m[0] * L + 2 * p1 * m[0] * m[1] + p2 * (r**2 + 2 * m[0] ** 2)
    y = m[1] * L + p1 * (r**2 + 2 * m[1] ** 2) + 2 * p2 * m[0] * m[1]
    return K["fx"] * x + K["cx"], K["fy"] * y + K["cy"]


@pytest.mark.parametrize("xi", XI)
def test_the_unified_model_equals_its_formula_wherever_it_sees(xi: float) -> None:
    points = points_all_round()
    pixels, valid = unified_lens(xi).project(points)
    expected = np.array([mei_pixel(xi, point) for point in points[valid]])
    # Pixels reach 1e5 where a lens without xi sees 85 degrees off its axis.
    np.testing.assert_allclose(pixels[valid], expected, rtol=1e-12, atol=1e-9)
    if xi > 0.5:  # it sees behind itself
        assert (points[valid, 2] < 0).sum() > 200


def test_a_panorama_equals_longitude_and_latitude() -> None:
    points = points_all_round()
    pixels, valid = PANORAMA.project(points)
    longitude = np.arctan2(points[:, 0], points[:, 2])
    latitude = np.arcsin(points[:, 1] / np.linalg.norm(points, axis=1))
    expected = np.column_stack(
        [WIDTH * (0.5 + longitude / (2 * np.pi)), HEIGHT * (0.5 + latitude / np.pi)]
    )
    assert valid.all()
    np.testing.assert_allclose(pixels + 0.5, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("lens", [*map(unified_lens, XI), PANORAMA], ids=[*map(str, XI), "360"])
def test_jacobians_equal_differences_all_round(lens: Lens) -> None:
    """Also where a lens does not see, and its projection is continued."""
    points = points_all_round(400)
    jacobians = lens.project_with_jacobian(points)[1]
    step = 1e-6 * np.linalg.norm(points, axis=1, keepdims=True)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, behind = lens.project(points + shift)[0], lens.project(points - shift)[0]
        numeric = lens.subtract(ahead, behind) / (2 * step)
        size = np.abs(jacobians).max(axis=(1, 2))[:, None]
        # Relative: step^2 of truncation, and 1e-16 of a pixel's size in steps of 1e-6.
        assert (np.abs(jacobians[:, :, axis] - numeric) < 1e-7 * size + 1e-4 / step * 1e-6).all()


@pytest.mark.parametrize("lens", [*map(unified_lens, XI), PANORAMA], ids=[*map(str, XI), "360"])
def test_rays_are_the_inverse_all_round(lens: Lens) -> None:
    points = points_all_round()
    pixels, valid = lens.project(points)
    rays, found = unproject(lens, pixels[valid])
    assert found.all()
    expected = points[valid] / np.linalg.norm(points[valid], axis=1, keepdims=True)
    assert np.abs(rays - expected).max() < 1e-9


def test_residuals_cross_the_seam_of_a_panorama_the_short_way() -> None:
    """A point just left of the seam, seen just right of it, is 2 px off, not 1998."""
    angle = np.pi - 1.0 / PANORAMA.packed[0]
    point = 5.0 * np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    pixel = np.array([[-0.5 + 1.0, (HEIGHT - 1) / 2]])
    block = ProjectionBlock(PANORAMA, point, pixel)
    residuals, valid = block.residuals(gtsam.Pose3())
    np.testing.assert_allclose(residuals, [[-2.0, 0.0]], atol=1e-9)
    assert valid.all()
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    one = projection_factor(0, PANORAMA, point[0], pixel[0], loss="cauchy", scale=4.0)
    assert block_factor(0, block).error(values) == pytest.approx(one.error(values), rel=1e-12)
    assert one.error(values) < 4.0


def test_the_poles_of_a_panorama_are_not_seen() -> None:
    pixels, valid = PANORAMA.project([[0.0, 3.0, 0.0], [0.0, -3.0, 0.0], [1e-3, 3.0, 0.0]])
    assert valid.tolist() == [False, False, True]
    assert np.isfinite(pixels).all()
    assert np.isfinite(PANORAMA.project_with_jacobian([[0.0, 3.0, 0.0]])[1]).all()


def test_the_field_of_a_unified_lens_ends_where_it_folds() -> None:
    """Without distortion sin t / (cos t + xi) grows up to arccos(-1 / xi)."""
    lens = Lens.omnidirectional(**K, distortion=(2.0, 0.0, 0.0, 0.0, 0.0))
    angle = np.radians([119.0, 121.0])
    _, valid = lens.project(np.column_stack([np.sin(angle), np.zeros(2), np.cos(angle)]))
    assert valid.tolist() == [True, False]


@pytest.mark.parametrize("xi", [-0.1, 101.0, np.nan])
def test_an_impossible_mirror_is_refused(xi: float) -> None:
    with pytest.raises(ValueError, match="xi of the unified model"):
        Lens.omnidirectional(**K, distortion=(xi, 0.0, 0.0, 0.0, 0.0))
