"""Clouds of one place are aligned, from other positions and headings; those of others are not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.io.rigs import load_rig
from calibgraph.matching.cloud_similarity import Z_UP, UprightCloud, align_with_any, find_up
from calibgraph.model.geometry import invert, transform
from tests.conftest import SAMPLE
from tests.matching.streets import STOPS, displaced, scan_at

Array = NDArray[np.float64]


def cloud_at(T_world_lidar: Array, seed: int = 0) -> UprightCloud:
    return UprightCloud.from_cloud(scan_at(T_world_lidar, seed))


@pytest.mark.parametrize(("stop", "turned_deg"), [(0, 77.0), (1, 0.0), (1, 180.0)])
def test_the_motion_between_two_scans_of_a_place_is_found(stop: int, turned_deg: float) -> None:
    """It decides about 20 m: a twentieth is enough, and the turn between two images from above."""
    T_first = STOPS[0]
    T_now = displaced(STOPS[stop], left_m=2.0, turned_deg=turned_deg)
    first, now = cloud_at(T_first), cloud_at(T_now, seed=1)
    found = align_with_any(now, [first])
    assert found is not None
    row, T_now_first = found
    assert row == 0
    off = T_now_first @ invert(T_first) @ T_now
    assert np.linalg.norm(off[:3, 3]) < 1.0
    assert np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude()) < 1.5


def test_other_places_are_not_aligned() -> None:
    """40 m on in the same street, and in another one."""
    now = cloud_at(STOPS[5])
    other = UprightCloud.from_cloud(np.load(SAMPLE / "lidar" / "000000.npy"))
    assert align_with_any(now, [cloud_at(STOPS[0]), other]) is None


def test_of_many_known_places_the_nearest_is_found() -> None:
    known = [cloud_at(T) for T in STOPS]
    now = cloud_at(displaced(STOPS[3], left_m=1.0, turned_deg=5.0), seed=1)
    found = align_with_any(now, known)
    assert found is not None and found[0] == 3


def test_where_nothing_is_upright_nothing_is_known() -> None:
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-40, 40, (5000, 2)), rng.normal(-1.8, 0.01, 5000)])
    empty = np.empty((0, 4), np.float32)
    for cloud in (flat, empty):
        assert (
            align_with_any(UprightCloud.from_cloud(cloud), [UprightCloud.from_cloud(cloud)]) is None
        )
    assert align_with_any(UprightCloud.from_cloud(flat), []) is None


AXES = {
    "optical": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "on its side": Rotation.from_euler("x", 90, degrees=True).as_matrix(),
    "upside down": Rotation.from_euler("x", 180, degrees=True).as_matrix(),
    "tilted": Rotation.from_euler("yx", (45, 20), degrees=True).as_matrix(),
}


@pytest.mark.parametrize("axes", AXES)
def test_up_is_found_in_clouds_of_other_axes_by_cameras_and_ground(axes: str) -> None:
    """To 3 deg, as exactly as the ground is level; with z up nothing is turned, to the last bit."""
    rig, cloud = load_rig(SAMPLE / "reference.yaml"), np.load(SAMPLE / "lidar" / "000000.npy")
    cameras = [*rig.T_camera_lidar.values()]
    assert find_up(cloud, cameras) is Z_UP
    T_axes_lidar = transform(AXES[axes])
    turned = cloud[:, :3] @ AXES[axes].T
    R_up_axes = find_up(turned, [T @ invert(T_axes_lidar) for T in cameras])
    assert R_up_axes is not None
    assert (R_up_axes @ AXES[axes])[2, 2] > np.cos(np.radians(3.0))
