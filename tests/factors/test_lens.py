from __future__ import annotations

import cv2
import numpy as np
import pytest

from factors import Lens

K = {"fx": 718.0, "fy": 710.0, "cx": 607.0, "cy": 185.0}
MATRIX = np.array([[718.0, 0, 607], [0, 710.0, 185], [0, 0, 1]])

RADTAN = {
    0: (),
    4: (-0.11, 0.05, 0.001, -0.002),
    5: (-0.11, 0.05, 0.001, -0.002, 0.004),
    8: (0.3, -0.1, 0.0005, 0.001, 0.02, 0.35, -0.05, 0.01),
}
KANNALA = (0.02, -0.004, 0.001, -0.0002)

LENSES = {f"radtan{n}": Lens.pinhole(**K, distortion=d) for n, d in RADTAN.items()}
LENSES["fisheye"] = Lens.fisheye(**K, distortion=KANNALA)
LENSES["omnidirectional"] = Lens.omnidirectional(**K, distortion=(1.2, *RADTAN[4]))
LENSES["equirectangular"] = Lens.equirectangular(**K)


def random_points(seed: int, count: int, spread: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 60, count)
    return (
        np.column_stack([rng.uniform(-spread, spread, (count, 2)), np.ones(count)]) * depth[:, None]
    )


@pytest.mark.parametrize("count", RADTAN)
def test_pinhole_agrees_with_opencv(count: int) -> None:
    points = random_points(1, 500, 0.9)
    pixels, valid = Lens.pinhole(**K, distortion=RADTAN[count]).project(points)
    distortion = np.array(RADTAN[count]) if count else None
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, distortion)
    assert valid.all()
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-9)


def test_fisheye_agrees_with_opencv() -> None:
    points = random_points(2, 500, 4.0)  # up to 80 degrees off the axis
    pixels, valid = LENSES["fisheye"].project(points)
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), MATRIX, np.array(KANNALA)
    )
    assert valid.all()
    np.testing.assert_allclose(pixels, expected[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", LENSES)
def test_jacobian_agrees_with_finite_differences(name: str) -> None:
    lens = LENSES[name]
    for point in [*random_points(3, 50, 0.9), np.array([1e-7, -1e-7, 5.0]), [0.0, 0.0, 3.0]]:
        jacobian = lens.project_with_jacobian(point)[1][0]
        step = 1e-6 * np.linalg.norm(point)
        numeric = np.empty((2, 3))
        for axis in range(3):
            shift = step * np.eye(3)[axis]
            ahead, _ = lens.project(point + shift)
            behind, _ = lens.project(point - shift)
            numeric[:, axis] = (ahead - behind)[0] / (2 * step)
        # Central differences: truncation step^2 / 6 f''' and rounding eps |pixel| / step.
        np.testing.assert_allclose(jacobian, numeric, atol=2e-16 * 1e4 / step + 1e-6 * 720)


def test_points_behind_a_pinhole_are_invalid() -> None:
    _, valid = LENSES["radtan5"].project([[0.1, 0.1, -5.0], [0.1, 0.1, 0.0], [0.1, 0.1, 5.0]])
    assert valid.tolist() == [False, False, True]


def test_where_the_distortion_folds_back_a_point_is_invalid() -> None:
    # r (1 - 0.3 r^2) grows until r^2 = 1 / 0.9: OpenCV maps r = 1.5 back into the image.
    lens = Lens.pinhole(**K, distortion=(-0.3, 0.0, 0.0, 0.0))
    radii = np.array([0.5, 1.05, 1.06, 1.5])
    points = np.column_stack([radii, np.zeros(4), np.ones(4)])
    pixels, valid = lens.project(points)
    folded = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, lens.packed[4:8])[0]
    assert folded[3, 0, 0] < folded[1, 0, 0]
    assert valid.tolist() == [True, True, False, False]
    assert np.all(np.diff(pixels[:, 0]) > 0)


def test_a_fisheye_sees_behind_itself() -> None:
    lens = Lens.fisheye(**K, distortion=(0.0, 0.0, 0.0, 0.0))
    pixels, valid = lens.project([[1.0, 0.0, -0.2]])
    theta = np.pi / 2 + np.arctan(0.2)  # equidistant: r = f theta
    np.testing.assert_allclose(pixels, [[718 * theta + 607, 185.0]])
    assert valid.all()


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


@pytest.mark.parametrize("count", [1, 2, 3, 6, 12])
def test_other_numbers_of_coefficients_are_refused(count: int) -> None:
    with pytest.raises(ValueError, match="distortion coefficients"):
        Lens.pinhole(**K, distortion=(0.1,) * count)
    with pytest.raises(ValueError, match="expected 4"):
        Lens.fisheye(**K, distortion=(0.1,) * count)


def test_a_focal_length_must_be_positive() -> None:
    with pytest.raises(ValueError, match="focal"):
        Lens.pinhole(fx=0.0, fy=1.0, cx=0.0, cy=0.0)
