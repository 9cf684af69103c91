"""The simulated LiDAR: ranges, dropouts, intensities, and its errors."""

from dataclasses import replace

import numpy as np
import pytest

from calibgraph.simulation.lidar import lidar_of, return_chance, scan, shot_directions
from calibgraph.simulation.recording import Drive
from calibgraph.simulation.world import cast, find_albedos
from tests.simulation.conftest import SCAN
from tools.scenes.scan_errors import ScanErrors

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


def test_32_beams_cover_a_sector_and_the_others_a_full_turn() -> None:
    sector, full = (shot_directions(lidar_of(beams)) for beams in (32, 16))
    azimuth_deg = np.degrees(np.arctan2(sector[:, 1], sector[:, 0]))
    assert len(sector) == 32 * 400 and len(full) == 16 * 1800
    assert np.isclose(azimuth_deg.min(), -46.0) and np.isclose(azimuth_deg.max(), 113.6)


EXACT = replace(SCAN, range_noise_m=0.0, dropout=0.0)


def scanned(drive: Drive, errors: ScanErrors) -> np.ndarray:
    T, rng = drive.T_world_lidar[0], np.random.default_rng(1)
    return scan(drive.world, replace(EXACT, errors=errors), np.ones(16), T, rng=rng).astype(float)


def elevations_deg(cloud: np.ndarray) -> np.ndarray:
    return np.degrees(np.arctan2(cloud[:, 2], np.hypot(cloud[:, 0], cloud[:, 1])))


def test_points_lie_at_the_elevations_that_are_reported(drive: Drive) -> None:
    """The ranges are those of where the beams are: 0.5 degrees higher."""
    cloud = scanned(drive, ScanErrors(elevations_deg=(0.5,) * 16))
    reported = np.array(SCAN.elevations_deg)
    nearest = np.abs(elevations_deg(cloud)[:, None] - reported).min(axis=1)
    assert nearest.max() < 1e-3
    flat = cloud[:, :2] / np.linalg.norm(cloud[:, :2], axis=1)[:, None]
    fired = np.radians(elevations_deg(cloud) + 0.5)
    rays = np.column_stack([flat * np.cos(fired)[:, None], np.sin(fired)])
    T = drive.T_world_lidar[0]
    truth = cast(drive.world, T[:3, 3], (rays @ T[:3, :3].T).astype(np.float32)).distance_m
    error = np.linalg.norm(cloud[:, :3], axis=1) - truth
    assert np.mean(np.abs(error) < 0.02) > 0.98  # single precision, at the edges of objects


def test_a_moving_sensor_is_behind_when_it_looks_right_and_ahead_when_left(drive: Drive) -> None:
    whole = scanned(drive, ScanErrors(motion_m=0.4))
    T = drive.T_world_lidar[0]
    azimuth = np.arctan2(whole[:, 1], whole[:, 0])
    origins = T[:3, 3] + 0.4 * (azimuth / (2 * np.pi))[:, None] * T[:3, 0]
    ranges = np.linalg.norm(whole[:, :3], axis=1)
    rays = (whole[:, :3] / ranges[:, None] @ T[:3, :3].T).astype(np.float32)
    assert np.mean(np.abs(cast(drive.world, origins, rays).distance_m - ranges) < 0.02) > 0.98
