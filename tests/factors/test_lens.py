"""Lenses against OpenCV and the formulas of their papers; their derivatives, rays and limits."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from factors import Lens, ray_spreads, unproject
from tests.conftest import KANNALA, RADTAN5, RADTAN8
from tests.factors.blocks import K

Array = NDArray[np.float64]

MATRIX = np.array([[718.0, 0, 607], [0, 710.0, 185], [0, 0, 1]])
RADTAN = {0: (), 4: RADTAN5[:4], 5: RADTAN5, 8: RADTAN8}
MIRROR = (-0.06, 0.02, 0.001, -0.002)
XI = [0.0, 0.7, 1.0, 1.6, 2.8]
ALL_ROUND = {f"xi {xi}": Lens.of("omnidirectional", **K, distortion=(xi, *MIRROR)) for xi in XI}
LENSES = {f"radtan{n}": Lens.of("pinhole", **K, distortion=d) for n, d in RADTAN.items()}
LENSES["fisheye"] = Lens.of("fisheye", **K, distortion=KANNALA)
LENSES["omnidirectional"] = Lens.of("omnidirectional", **K, distortion=(1.2, *RADTAN[4]))
WIDE = Lens.of(
    "fisheye", fx=385.0, fy=384.0, cx=641.0, cy=478.0, distortion=(0.05, -0.015, 0.004, -0.001)
)


def points_ahead(seed: int, count: int, spread: float) -> Array:
    rng = np.random.default_rng(seed)
    rays = np.column_stack([rng.uniform(-spread, spread, (count, 2)), np.ones(count)])
    return rays * rng.uniform(0.5, 60, count)[:, None]


def points_all_round(count: int = 2000) -> Array:
    rng = np.random.default_rng(0)
    rays = rng.standard_normal((count, 3))
    rays *= np.exp(rng.uniform(-1, 4, (count, 1))) / np.linalg.norm(rays, axis=1, keepdims=True)
    return rays


@pytest.mark.parametrize("count", RADTAN)
def test_pinhole_agrees_with_opencv(count: int) -> None:
    points = points_ahead(1, 500, 0.9)
    pixels, valid = Lens.of("pinhole", **K, distortion=RADTAN[count]).project(points)
    distortion = np.array(RADTAN[count]) if count else None
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, distortion)
    assert valid.all()
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-9)


def test_fisheye_agrees_with_opencv() -> None:
    points = points_ahead(2, 500, 4.0)  # up to 80 degrees off the axis
    pixels, valid = LENSES["fisheye"].project(points)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), MATRIX, np.array(KANNALA)
    )
    assert valid.all()
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-9)
    equidistant = Lens.of("fisheye", **K, distortion=(0.0,) * 4)  # r = f theta, also behind
    pixels, valid = equidistant.project([[1.0, 0.0, -0.2]])
    assert valid.all()
    np.testing.assert_allclose(pixels, [[718 * (np.pi / 2 + np.arctan(0.2)) + 607, 185.0]])


def mei_pixel(xi: float, point: Array) -> tuple[float, float]:
    """Mei and Rives (2007), step by step; distortion as in cv2.omnidir.projectPoints."""
    X = point / np.sqrt(point @ point)
    m = np.array([X[0] / (X[2] + xi), X[1] / (X[2] + xi)])
    k1, k2, p1, p2 = MIRROR
    r = np.sqrt(m[0] ** 2 + m[1] ** 2)
    L = 1 + k1 * r**2 + k2 * r**4
    x = m[0] * L + 2 * p1 * m[0] * m[1] + p2 * (r**2 + 2 * m[0] ** 2)
    y = m[1] * L + p1 * (r**2 + 2 * m[1] ** 2) + 2 * p2 * m[0] * m[1]
    return K["fx"] * x + K["cx"], K["fy"] * y + K["cy"]


@pytest.mark.parametrize("xi", XI)
def test_the_unified_model_equals_its_formula_wherever_it_sees(xi: float) -> None:
    points = points_all_round()
    pixels, valid = ALL_ROUND[f"xi {xi}"].project(points)
    expected = np.array([mei_pixel(xi, point) for point in points[valid]])
    # Pixels reach 1e5 where a lens without xi sees 85 degrees off its axis.
    np.testing.assert_allclose(pixels[valid], expected, rtol=1e-12, atol=1e-9)
    if xi > 0.5:  # it sees behind itself
        assert (points[valid, 2] < 0).sum() > 200


AHEAD = np.vstack([points_ahead(3, 50, 0.9), [1e-7, -1e-7, 5.0], [0.0, 0.0, 3.0]])


@pytest.mark.parametrize(
    ("lens", "points"),
    [
        *((lens, AHEAD) for lens in LENSES.values()),
        *((lens, points_all_round(400)) for lens in ALL_ROUND.values()),
    ],
    ids=[*LENSES, *ALL_ROUND],
)
def test_jacobians_equal_differences(lens: Lens, points: Array) -> None:
    """Also where a lens does not see, and its projection is continued."""
    jacobians = lens.project_with_jacobian(points)[1]
    step = 1e-6 * np.linalg.norm(points, axis=1, keepdims=True)
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        ahead, behind = lens.project(points + shift)[0], lens.project(points - shift)[0]
        numeric = (ahead - behind) / (2 * step)
        size = np.abs(jacobians).max(axis=(1, 2))[:, None]
        # Relative: step^2 of truncation, and 1e-16 of a pixel's size in steps of 1e-6.
        assert (np.abs(jacobians[:, :, axis] - numeric) < 1e-7 * size + 1e-4 / step * 1e-6).all()


@pytest.mark.parametrize("lens", ALL_ROUND.values(), ids=ALL_ROUND)
def test_rays_are_the_inverse_all_round(lens: Lens) -> None:
    points = points_all_round()
    pixels, valid = lens.project(points)
    rays, found = unproject(lens, pixels[valid])
    assert found.all()
    expected = points[valid] / np.linalg.norm(points[valid], axis=1, keepdims=True)
    assert np.abs(rays - expected).max() < 1e-9


@pytest.mark.parametrize("lens", [*LENSES.values(), WIDE], ids=[*LENSES, "wide"])
def test_rays_project_to_their_pixels_and_spreads_are_their_derivatives(lens: Lens) -> None:
    v, u = np.mgrid[5:370:20, 110:1180:20]  # at most 103 deg off the axis of the widest
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    rays, valid = unproject(lens, pixels)
    assert valid.all()
    assert np.abs(np.linalg.norm(rays, axis=1) - 1).max() < 1e-14
    assert np.abs(lens.project(rays)[0] - pixels).max() < 1e-9
    spreads = ray_spreads(lens, rays)
    for axis in range(2):
        step = np.eye(2)[axis] * 1e-3
        difference = (unproject(lens, pixels + step)[0] - unproject(lens, pixels - step)[0]) / 2e-3
        # Rounding of a difference of numbers near 1 over 2e-3 is 1e-13; its curvature is smaller.
        assert np.abs(spreads[:, :, axis] - difference).max() < 1e-9


def test_pixels_outside_the_lens_have_no_ray() -> None:
    folded = Lens.of(
        "pinhole", fx=700.0, fy=700.0, cx=600.0, cy=200.0, distortion=(-0.4, 0.0, 0.0, 0.0)
    )
    _, valid = unproject(folded, np.array([[600.0, 200.0], [3000.0, 200.0], [np.nan, 0.0]]))
    assert valid.tolist() == [True, False, False]
    _, valid = unproject(WIDE, np.array([[641.0, 478.0], [10.0, 5.0]]))  # its corner is black
    assert valid.tolist() == [True, False]


def angles_deg(*angles: float) -> Array:
    """Points of one metre in the plane of x and z, at angles off the axis."""
    radians = np.radians(angles)
    return np.column_stack([np.sin(radians), np.zeros(len(radians)), np.cos(radians)])


@pytest.mark.parametrize(
    ("lens", "points", "expected"),
    [
        (LENSES["radtan5"], [[0.1, 0.1, -5.0], [0.1, 0.1, 0.0], [0.1, 0.1, 5.0]], [0, 0, 1]),
        # Without distortion sin t / (cos t + xi) grows up to arccos(-1 / xi), 120 deg.
        (Lens.of("omnidirectional", **K, distortion=(2, 0, 0, 0, 0)), angles_deg(119, 121), [1, 0]),
    ],
    ids=["behind", "mirror"],
)
def test_what_a_lens_does_not_see_is_invalid_and_finite(
    lens: Lens, points: Array, expected: list[int]
) -> None:
    pixels, valid = lens.project(points)
    assert valid.tolist() == [bool(one) for one in expected]
    assert np.isfinite(pixels).all()
    assert np.isfinite(lens.project_with_jacobian(points)[1]).all()


def test_a_distortion_is_valid_up_to_where_it_folds_back() -> None:
    for distortion, limit in (
        ((-0.31, 0, 0, 0), np.sqrt(1 / 0.93)),  # r (1 - 0.31 r^2) grows until r^2 = 1 / 0.93
        ((-0.3, 0, 0, 0, 0, 0.1, 0, 0), 0.9857),  # until 0.03 r^4 + r^2 = 1
    ):
        lens = Lens.of("pinhole", **K, distortion=distortion)
        points = np.array([[limit - 0.003, 0, 1], [limit + 0.003, 0, 1], [1.5, 0, 1]])
        assert lens.project(points)[1].tolist() == [True, False, False]
        assert np.isfinite(lens.project_with_jacobian(points)[1]).all()


@pytest.mark.parametrize("name", LENSES)
def test_projection_is_continuous_and_finite_outside_its_domain(name: str) -> None:
    lens = LENSES[name]
    # A path from well in front, past the field of view, to behind the camera.
    jumps = []
    for steps in (100_000, 200_000):
        angle = np.linspace(0.0, 0.999 * np.pi, steps + 1)
        path = 4.0 * np.column_stack([np.sin(angle), 0.3 * np.sin(angle), np.cos(angle)])
        pixels, _ = lens.project(path)
        assert np.isfinite(pixels).all()
        jumps.append(np.abs(np.diff(pixels, axis=0)).max())
    assert jumps[1] < 0.6 * jumps[0]  # a step half as long: a jump would stay as it is
    assert np.isfinite(lens.project([[0.0, 0.0, -3.0], [0.0, 0.0, 0.0]])[0]).all()


@pytest.mark.parametrize(
    ("model", "settings", "message"),
    [
        *(
            ("pinhole", {"distortion": (0.1,) * count}, "distortion coefficients")
            for count in (1, 2, 3, 6, 12)
        ),
        *(("fisheye", {"distortion": (0.1,) * count}, "expected 4") for count in (0, 3, 5)),
        *(
            ("omnidirectional", {"distortion": (xi, 0.0, 0.0, 0.0, 0.0)}, "xi of the unified")
            for xi in (-0.1, 101.0, np.nan)
        ),
        ("pinhole", {"fx": 0.0}, "focal"),
    ],
)
def test_an_impossible_lens_is_refused(model, settings, message) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=message):
        Lens.of(model, **{**K, **settings})
