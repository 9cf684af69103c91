"""Samples: published perturbations, true flow, augmentation that keeps image and cloud together."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibgraph import Dataset
from calibgraph.matching.cmrnext.inputs import View
from calibgraph.matching.cmrnext.training.samples import (
    _mirror,
    _turn,
    draw_perturbation,
    make_sample,
)
from tests.matching.cmrnext.training.tiny import TINY, scene


def test_perturbations_are_those_of_the_published_protocol() -> None:
    """Median angle about 19.6 deg and length 1.42 to 1.45 m, as in the original's logs."""
    rng = np.random.default_rng(0)
    draws = np.array([draw_perturbation(rng, 20.0, 1.5) for _ in range(4000)])
    angles = np.degrees(Rotation.from_matrix(draws[:, :3, :3]).magnitude())
    lengths = np.linalg.norm(draws[:, :3, 3], axis=1)
    # Medians of 4000: sigma about 1.25 spread / sqrt(4000), so 0.13 deg and 0.008 m.
    assert np.median(angles) == pytest.approx(19.6, abs=0.5)
    assert np.median(lengths) == pytest.approx(1.43, abs=0.04)
    assert draws[:, 1, 3].max() <= 1.0 and draws[:, 0, 3].max() > 1.4


@pytest.mark.parametrize("change", [_mirror, _turn])
def test_augmented_clouds_still_fit_their_images(trusted: Dataset, change: object) -> None:
    """Points keep the colour of the pixel that they lie on."""
    some = scene(trusted)
    view = View(some.camera)
    image = view.undistort(some.frame.load_image(some.name, some.camera))
    cloud = some.frame.load_cloud().astype(np.float64)
    T = some.camera.T_camera_lidar
    cloud[:, :3] = cloud[:, :3] @ T[:3, :3].T + T[:3, 3]
    rng = np.random.default_rng(1)  # its first draw mirrors
    changed_image, changed = change(image, cloud, view, rng)  # type: ignore[operator]
    assert not np.array_equal(changed_image, image)

    def colours(picture: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = view.project(points[:, :3])
        size = [view.width - 1, view.height - 1]
        inside = (points[:, 2] > 1) & ((pixels > 0) & (pixels < size)).all(axis=1)
        x, y = np.where(inside[:, None], pixels, 0).round().astype(int).T
        return picture[y, x].astype(float), inside

    before, seen_before = colours(image, cloud)
    after, seen_after = colours(changed_image, changed)
    both = seen_before & seen_after
    assert np.count_nonzero(both) > 1000
    difference = np.abs(before - after)[both].max(axis=1)
    shuffled = np.abs(before[both] - np.roll(after[both], 500, axis=0)).max(axis=1)
    # Interpolation blurs the texture: half of the points within 8 of 255, and by chance few.
    assert np.median(difference) < 8 < 0.5 * np.median(shuffled)


def test_the_flow_of_a_sample_leads_to_the_true_pixel(trusted: Dataset) -> None:
    some = scene(trusted)
    settings = TINY.changed(half_resolution=True)
    sample = make_sample(some, settings, np.random.default_rng(0), augment=False)
    assert sample is not None
    view = View(some.camera)
    expected = view.project(sample.points_camera_m)
    np.testing.assert_allclose(sample.pixels_px + sample.flow_px.numpy(), expected, atol=1e-3)
    perturbed = sample.points_camera_m @ np.linalg.inv(sample.E)[:3, :3].T
    start = view.project(perturbed + np.linalg.inv(sample.E)[:3, 3])
    np.testing.assert_allclose(sample.pixels_px, start, atol=1e-3)
    assert np.array_equal(sample.cells.numpy(), np.floor(sample.pixels_px[:, ::-1]))
    assert sample.rgb.shape[1:] == sample.lidar.shape[1:]
