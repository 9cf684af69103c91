"""Rays of pixels, and where another lens sees them."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Camera, Intrinsics, Rig, evaluate
from calibgraph.model.lens_difference import corners_of, lens_difference, rays_of
from tests.conftest import make_camera

WIDTH, HEIGHT = 1240, 376


def camera_of(model: str, distortion: tuple[float, ...] = (), focal: float = 600.0) -> Camera:
    camera = make_camera()
    k = Intrinsics(fx=focal, fy=focal, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2)
    changes = {"model": model, "distortion": distortion, "intrinsics_px": k}
    return camera.model_copy(update={**changes, "width_px": WIDTH, "height_px": HEIGHT})


@pytest.mark.parametrize(
    "camera",
    [
        camera_of("pinhole"),
        camera_of("pinhole", (-0.3, 0.1, 0.001, 0.001, 0.0)),
        camera_of("fisheye", (0.02, 0.01, 0.0, 0.0), 300.0),  # 236 degrees wide
        camera_of("omnidirectional", (1.2, 0.1, 0.0, 0.0, 0.0)),
        camera_of("equirectangular", (), WIDTH / (2 * np.pi)),
    ],
)
def test_rays_of_pixels_are_seen_at_these_pixels(camera: Camera) -> None:
    pixels = np.random.default_rng(0).uniform((0, 0), (WIDTH, HEIGHT), (200, 2))
    pixels = np.vstack([pixels, corners_of(camera)])
    rays = rays_of(camera, pixels)
    seen, valid = camera.lens.project(5.0 * rays)
    assert valid.all()
    assert np.linalg.norm(rays, axis=1) == pytest.approx(1.0)
    assert camera.lens.subtract(seen, pixels) == pytest.approx(0.0, abs=1e-6)


def test_a_pixel_beyond_the_domain_of_the_lens_has_no_ray() -> None:
    camera = camera_of("pinhole", (-0.5, 0.0, 0.0, 0.0))  # turns back beyond 47 degrees
    rays = rays_of(camera, np.array([[620.0, 187.0], [3000.0, 187.0]]))
    assert np.isfinite(rays[0]).all() and np.isnan(rays[1]).all()


def test_a_longer_focal_length_moves_pixels_away_from_the_centre() -> None:
    before, after = camera_of("pinhole"), camera_of("pinhole", (), 606.0)
    pixels = np.array([[619.5, 187.5], [719.5, 137.5], [0.0, 0.0]])
    centre = np.array([619.5, 187.5])
    assert lens_difference(before, after, pixels) == pytest.approx(0.01 * (pixels - centre))


def test_rigs_are_compared_by_their_lenses_in_the_corners() -> None:
    before, after = camera_of("pinhole"), camera_of("pinhole", (), 606.0)
    narrow = camera_of("pinhole", (-0.5, 0.0, 0.0, 0.0), 500.0)  # of the corners it has no ray
    apart = evaluate(
        Rig(cameras={"a": after, "same": before, "lost": before}),
        Rig(cameras={"a": before, "same": before, "lost": narrow}),
    ).lens_px
    assert apart.keys() == {"a", "lost"}
    assert apart["a"] == pytest.approx(0.01 * np.hypot(619.5, 187.5))
    assert apart["lost"] == np.inf


def test_lenses_of_images_that_differ_in_size_are_not_compared() -> None:
    camera = camera_of("pinhole")
    half = camera.model_copy(update={"width_px": WIDTH // 2})
    found = evaluate(Rig(cameras={"a": camera}), Rig(cameras={"a": half}))
    assert np.isnan(found.lens_px["a"])
    assert found.to_mapping()["lens_px"] == {"a": None}
