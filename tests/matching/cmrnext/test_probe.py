"""The probe for dependence on the start."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.matching.cmrnext import probe
from tests.conftest import make_camera
from tests.matching.cmrnext.builders import cloud_before

Array = NDArray[np.float64]


def test_the_remaining_share_is_that_of_matches_that_follow_the_start() -> None:
    camera = make_camera()
    rig = calibgraph.Rig(cameras={"camera": camera})
    cloud = cloud_before(camera, 2000)
    T_two = probe.displace(camera.T_camera_lidar, (1.0, 0.1), np.random.default_rng(0))
    moved = T_two @ np.linalg.inv(camera.T_camera_lidar)
    assert np.degrees(Rotation.from_matrix(moved[:3, :3]).magnitude()) == pytest.approx(
        0.7 * np.sqrt(3), rel=1e-6
    )
    rng = np.random.default_rng(1)
    points = cloud[:, :3].astype(np.float64)

    def table(T: Array, share: float) -> calibgraph.Correspondences:
        """Matches that follow the start by a share, with noise."""
        truth, start = (
            camera.lens.project(points @ M[:3, :3].T + M[:3, 3])[0]
            for M in (rig.T_camera_lidar["camera"], T)
        )
        pixels = truth + share * (start - truth) + rng.normal(0, 1, truth.shape)
        return calibgraph.Correspondences.from_arrays(
            camera="camera", frame=0, pixels_px=pixels, points_lidar_m=points,
            point_index=np.arange(len(points)),
        )  # fmt: skip

    for share in (0.0, 0.4, 1.0):
        found = probe.remaining_share(camera, camera.T_camera_lidar, T_two, table(T_two, share))
        # Slope of 4000 values with noise 1 over motions of about 10 px: sigma 2e-3.
        assert found == pytest.approx(share, abs=0.01)
    few = table(T_two, 0.0).select(slice(0, 10))
    assert np.isnan(probe.remaining_share(camera, camera.T_camera_lidar, T_two, few))
