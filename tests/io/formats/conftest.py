import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibgraph import Calibration, Camera, MatcherErrors, Rig, simulate_correspondences, solve
from calibgraph.model.geometry import transform
from tests.conftest import make_camera, make_pair


def moved_camera(rotvec: tuple[float, float, float], t: tuple[float, float, float]) -> Camera:
    """A camera with a rotation vector and translation of T_camera_lidar."""
    return make_camera().moved_to(transform(Rotation.from_rotvec(rotvec), t))


def rolled(camera: Camera, angle_rad: float) -> Camera:
    """The camera turned about its optical axis."""
    turn = transform(Rotation.from_euler("z", angle_rad))
    return camera.moved_to(turn @ camera.T_camera_lidar)


def varied_rig() -> Rig:
    """Cameras without distortion: level, sideways, skew, and upright images, where pitch is 90."""
    return Rig(
        cameras={
            "front": make_camera((0.4, 0.1, -0.2)),
            "side": make_camera((0.0, 0.4, -0.1), yaw_deg=80),
            "skew": moved_camera((0.3, -1.9, 1.1), (1.5, -0.7, 0.2)),
            "portrait": rolled(make_camera((0.4, -0.1, -0.2)), np.pi / 2),
            "nearly": rolled(make_camera((0.4, -0.3, -0.2), yaw_deg=20), np.pi / 2 - 1e-7),
        }
    )


@pytest.fixture(scope="session")
def solved() -> Calibration:
    """A result with error bars."""
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.1)
    return solve(make_pair(), simulate_correspondences(make_pair(), frames=8, errors=errors))


@pytest.fixture(scope="session")
def failed() -> Calibration:
    """A result of nonsense."""
    nonsense = MatcherErrors(outlier_share=1.0)
    return solve(make_pair(), simulate_correspondences(make_pair(), errors=nonsense))
