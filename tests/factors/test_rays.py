"""Rays are the inverse of the projection, for every lens."""

from __future__ import annotations

import numpy as np
import pytest

from factors import Lens, ray_spreads, unproject
from tests.factors.blocks import LENSES

WIDE = Lens.fisheye(
    fx=385.0, fy=384.0, cx=641.0, cy=478.0, distortion=(0.05, -0.015, 0.004, -0.001)
)


@pytest.mark.parametrize("lens", [*LENSES.values(), WIDE], ids=[*LENSES, "wide"])
def test_rays_project_to_their_pixels(lens: Lens) -> None:
    v, u = np.mgrid[5:370:20, 110:1180:20]  # at most 103 deg off the axis of the widest
    pixels = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    rays, valid = unproject(lens, pixels)
    assert valid.all()
    assert np.abs(np.linalg.norm(rays, axis=1) - 1).max() < 1e-14
    assert np.abs(lens.project(rays)[0] - pixels).max() < 1e-9


def test_pixels_outside_the_lens_have_no_ray() -> None:
    folded = Lens.pinhole(fx=700.0, fy=700.0, cx=600.0, cy=200.0, distortion=(-0.4, 0.0, 0.0, 0.0))
    _, valid = unproject(folded, np.array([[600.0, 200.0], [3000.0, 200.0], [np.nan, 0.0]]))
    assert valid.tolist() == [True, False, False]
    _, valid = unproject(WIDE, np.array([[641.0, 478.0], [10.0, 5.0]]))  # its corner is black
    assert valid.tolist() == [True, False]


@pytest.mark.parametrize("lens", [*LENSES.values(), WIDE], ids=[*LENSES, "wide"])
def test_spreads_are_the_derivatives_of_the_rays(lens: Lens) -> None:
    pixels = np.random.default_rng(0).uniform([50, 20], [1200, 350], (50, 2))
    spreads = ray_spreads(lens, unproject(lens, pixels)[0])
    for axis in range(2):
        step = np.eye(2)[axis] * 1e-3
        difference = (unproject(lens, pixels + step)[0] - unproject(lens, pixels - step)[0]) / 2e-3
        # Rounding of a difference of numbers near 1 over 2e-3 is 1e-13; its curvature is smaller.
        assert np.abs(spreads[:, :, axis] - difference).max() < 1e-9
