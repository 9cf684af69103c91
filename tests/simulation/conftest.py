"""A short drive, a small camera and a coarse LiDAR, shared by the tests of the sensors."""

from dataclasses import replace
from pathlib import Path

import pytest

from calibgraph import Camera, Intrinsics, Rig
from calibgraph.simulation.lidar import lidar_of
from calibgraph.simulation.recording import Drive, build_drive, simulate_street
from tests.conftest import KANNALA, RADTAN5
from tests.draws.cameras import camera_at

LENSES: dict[str, tuple[float, ...]] = {
    "pinhole": (),
    "radtan": RADTAN5,
    "fisheye": KANNALA,
    "omnidirectional": (1.3, *RADTAN5[:4]),
}
FOCAL_PX = {"pinhole": 150.0, "radtan": 150.0, "omnidirectional": 140.0}
DRIVE_SEED = 3


SCAN = replace(lidar_of(16), azimuth_step_deg=1.0)
"""A coarse LiDAR."""


def small_camera(lens: str) -> Camera:
    focal = FOCAL_PX.get(lens, 62.0)  # 120 px from the centre: 39 degrees, fisheye 107
    intrinsics = Intrinsics(fx=focal, fy=focal + 1, cx=121.3, cy=73.8)
    model = "pinhole" if lens == "radtan" else lens
    return camera_at((240, 150), intrinsics, (0.3, 0.2, -0.3), model=model, distortion=LENSES[lens])


@pytest.fixture(scope="session")
def drive() -> Drive:
    return build_drive(frames=3, seed=DRIVE_SEED)


@pytest.fixture(scope="session")
def rig() -> Rig:
    return Rig(cameras={name: small_camera(name) for name in ("radtan", "fisheye")})


@pytest.fixture(scope="session")
def recording(rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "street"
    simulate_street(folder, rig, beams=16, frames=2, seed=5, rotation_deg=3, translation_m=0.2)
    return folder
