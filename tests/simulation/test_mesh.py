"""Meshes of solids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from calibgraph.simulation.mesh import mesh_of_solid
from calibgraph.simulation.solids import Solid, box, cylinder, ellipsoid


@pytest.mark.parametrize("make", [box, cylinder, ellipsoid])
def test_meshes_have_the_size_of_their_solids(make: Callable[..., Solid]) -> None:
    solid = replace(make((3.0, -2.0, 1.0), (4.0, 2.0, 2.0), (0.5,) * 4), yaw_deg=90.0)
    corners = mesh_of_solid(solid).corners_m.reshape(-1, 3)
    # A quarter turn lays its x axis along y. Round ones touch their extents at corners.
    assert np.allclose(corners.min(axis=0), [2.0, -4.0, 1.0], atol=1e-12)
    assert np.allclose(corners.max(axis=0), [4.0, 0.0, 3.0], atol=1e-12)
    a, b, c = (mesh_of_solid(solid).corners_m - [3.0, -2.0, 2.0]).swapaxes(0, 1)
    volume = np.abs(np.einsum("ij,ij->i", a, np.cross(b, c))).sum() / 6  # convex: cones add up
    exact = 16 * {"box": 1, "cylinder": np.pi / 4, "ellipsoid": np.pi / 6}[make.__name__]
    # Inscribed: 20 sides hold 20 / 2 pi sin(2 pi / 20) = 0.984 of a disc. The facets of a ball span
    # 90 / 8 degrees, so none is nearer than cos(11.25 deg) to the middle: 0.98^3 = 0.94 of it.
    assert 0.94 * exact < volume <= exact * (1 + 1e-12)
