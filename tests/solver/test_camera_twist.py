from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Camera
from calibgraph.solver.camera_twist import apply_twist, project_with_jacobian
from tests.conftest import KANNALA, RADTAN5, make_camera, points_in_front


@pytest.mark.parametrize(
    "camera",
    [
        make_camera((0.3, 0.1, -0.1)),
        make_camera(distortion=RADTAN5),
        make_camera(model="fisheye", distortion=KANNALA),
    ],
)
def test_the_jacobian_is_the_derivative_by_a_twist(camera: Camera) -> None:
    points = points_in_front(np.random.default_rng(0), 100)
    _, jacobian = project_with_jacobian(camera, points)
    step = 1e-6
    for index in range(6):
        twist = step * np.eye(6)[index]
        plus, minus = (
            project_with_jacobian(apply_twist(camera, sign * twist), points)[0] for sign in (1, -1)
        )
        # Central differences: rounding of 1e3 px / 2e-6, and a third derivative times 1e-12.
        np.testing.assert_allclose((plus - minus) / (2 * step), jacobian[:, :, index], atol=1e-4)
