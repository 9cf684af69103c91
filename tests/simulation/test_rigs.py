"""The named rigs."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.simulation.cameras import pixel_directions
from calibgraph.simulation.rigs import RIG_NAMES, rig_of


@pytest.mark.parametrize("name", RIG_NAMES)
def test_every_pixel_of_lenses_without_black_corners_sees(name: str) -> None:
    for camera in rig_of(name).cameras.values():
        w, h = camera.width_px - 0.5, camera.height_px - 0.5
        corners = np.array([[-0.5, -0.5], [w, -0.5], [-0.5, h], [w, h], [w / 2, h / 2]])
        seen = pixel_directions(camera, corners).any(axis=1)
        whole = camera.model in ("pinhole", "omnidirectional")  # no pole, no black corner
        assert seen.tolist() == [whole] * 4 + [True]
