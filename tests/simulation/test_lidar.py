"""The simulated LiDAR: ranges, dropouts and intensities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph.simulation.lidar import (
    lidar_of,
    return_chance,
    ring_gains,
    scan,
    shot_directions,
)
from calibgraph.simulation.recording import Drive
from calibgraph.simulation.world import cast, find_albedos
from tests.simulation.conftest import SCAN

pytestmark = pytest.mark.usefixtures("open3d")


def noiseless(drive: Drive, frame: int, directions: np.ndarray) -> np.ndarray:
    """Ranges along directions in the LiDAR's frame."""
    T = drive.T_world_lidar[frame]
    rays = (directions @ T[:3, :3].T).astype(np.float32)
    return cast(drive.world, T[:3, 3], rays).distance_m


def shots_of(points: np.ndarray) -> np.ndarray:
    """Which shot each point of a scan was."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) + 180
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    steps = round(360 / SCAN.azimuth_step_deg)
    column = np.rint(azimuth / SCAN.azimuth_step_deg).astype(int) % steps
    top, bottom = SCAN.elevations_deg[0], SCAN.elevations_deg[-1]
    ring = np.rint((top - elevation) / (top - bottom) * (len(SCAN.elevations_deg) - 1))
    return ring.astype(int) * steps + column


def test_range_noise_and_dropouts_are_as_configured(drive: Drive) -> None:
    T, shots = drive.T_world_lidar[0], shot_directions(SCAN)
    cloud = scan(drive.world, SCAN, np.ones(16), T, rng=np.random.default_rng(1))
    truth, index = noiseless(drive, 0, shots), shots_of(cloud)
    error = np.linalg.norm(cloud[:, :3], axis=1) - truth[index]
    sigma, n = SCAN.range_noise_m, len(cloud)
    assert abs(error.mean()) < 4 * sigma / np.sqrt(n)
    assert abs(error.std() - sigma) < 4 * sigma / np.sqrt(2 * n)
    directions = (shots @ T[:3, :3].T).astype(np.float32)
    albedo, incidence = find_albedos(
        drive.world, directions, cast(drive.world, T[:3, 3], directions)
    )
    within = (truth > SCAN.min_range_m) & (truth < SCAN.max_range_m)
    chance = np.where(within, return_chance(SCAN, albedo[:, 3] * incidence, truth), 0.0)
    # Noise moves shots across the limits of the range, and changes the chance by 1e-3 or so.
    assert abs(n - chance.sum()) < 4 * np.sqrt((chance * (1 - chance)).sum()) + 1e-3 * n


def test_far_dark_and_slanted_surfaces_return_less() -> None:
    lidar = lidar_of(64)
    near, far = return_chance(lidar, np.array([0.1, 0.1]), np.array([10.0, 80.0]))
    bright, dark = return_chance(lidar, np.array([0.8, 0.02]), np.array([60.0, 60.0]))
    assert near == pytest.approx(1 - lidar.dropout, abs=1e-6)
    assert far < 0.95 < bright
    assert dark < 0.7


def test_rings_keep_their_gains(drive: Drive) -> None:
    gains = ring_gains(SCAN, np.random.default_rng(2))
    plain = replace(SCAN, range_noise_m=0.0, intensity_noise=0.0)
    T = drive.T_world_lidar[0]
    alike, ringed = (scan(drive.world, plain, g, T, rng=np.random.default_rng(0))
                     for g in (np.ones(16), gains))  # fmt: skip
    ring = shots_of(alike) // 360
    unsaturated = (ringed[:, 3] > 0) & (ringed[:, 3] < 1) & (alike[:, 3] < 1)
    ratio = ringed[unsaturated, 3] / alike[unsaturated, 3]
    assert np.allclose(ratio, gains[ring[unsaturated]], rtol=1e-5)


def test_32_beams_cover_a_sector_and_the_others_a_full_turn() -> None:
    sector, full = (shot_directions(lidar_of(beams)) for beams in (32, 16))
    azimuth_deg = np.degrees(np.arctan2(sector[:, 1], sector[:, 0]))
    assert len(sector) == 32 * 400 and len(full) == 16 * 1800
    assert np.isclose(azimuth_deg.min(), -46.0) and np.isclose(azimuth_deg.max(), 113.6)
