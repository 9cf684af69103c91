"""Where another lens sees the rays of some pixels."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Camera, Intrinsics, Rig, evaluate
from calibgraph.model.lens_difference import lens_difference
from tests.conftest import make_camera

WIDTH, HEIGHT = 1240, 376


def camera_of(model: str, distortion: tuple[float, ...] = (), focal: float = 600.0) -> Camera:
    camera = make_camera()
    k = Intrinsics(fx=focal, fy=focal, cx=(WIDTH - 1) / 2, cy=(HEIGHT - 1) / 2)
    changes = {"model": model, "distortion": distortion, "intrinsics_px": k}
    return camera.model_copy(update={**changes, "width_px": WIDTH, "height_px": HEIGHT})


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
