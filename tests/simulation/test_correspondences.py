"""Simulated correspondences: errors as configured; rigs that see all round are calibrated."""

from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.simulation.correspondences import PoseSpread
from calibgraph.simulation.rigs import RIG_NAMES, rig_of
from calibgraph.solver.joint import solve_joint
from tests.conftest import require_near


def residuals(rig: Rig, table: Correspondences, name: str) -> np.ndarray:
    """(n, 2) observed minus true pixels."""
    rows, camera = table.of_camera(name), rig.cameras[name]
    T = camera.T_camera_lidar
    pixels, _ = camera.lens.project(rows.points_lidar_m @ T[:3, :3].T + T[:3, 3])
    return np.asarray(rows.pixels_px - pixels)


@pytest.mark.parametrize("name", RIG_NAMES)
def test_points_of_a_street_lie_in_the_image_and_before_walls(name: str) -> None:
    rig = rig_of(name)
    exact = MatcherErrors(noise_px=0.0)
    table = simulate_correspondences(rig, frames=2, matches=300, errors=exact, depth_m=None)
    for camera in rig.cameras:
        assert len(table.of_camera(camera)) == 600
        assert np.abs(residuals(rig, table, camera)).max() < 1e-6
        assert rig.cameras[camera].in_image(table.of_camera(camera).pixels_px).all()
    x, y, z = table.points_lidar_m.T
    assert z.min() > -1.74 and np.abs(y).max() < 12.01
    assert np.degrees(np.arctan2(z, np.hypot(x, y))).max() < 15


def test_a_field_is_shared_by_a_frame_and_a_bias_by_all() -> None:
    """Root mean squares over 400 frames are within 10 %: each has 12 numbers."""
    rig = rig_of("kitti")
    errors = MatcherErrors(noise_px=0.0, field_px=2.0)
    table = simulate_correspondences(rig, frames=400, matches=50, errors=errors, depth_m=None)
    found = residuals(rig, table, "image_2")
    assert np.sqrt(np.mean(found**2)) == pytest.approx(2.0, rel=0.1)
    means = found.reshape(400, 50, 2).mean(axis=1)
    assert abs(np.corrcoef(means[:-1, 0], means[1:, 0])[0, 1]) < 0.2  # 4 sigma of 399 pairs
    same = MatcherErrors(noise_px=0.0, bias_px=2.0)
    drives = [
        simulate_correspondences(rig, frames=20, matches=50, errors=same, depth_m=None, seed=seed)
        for seed in range(8)  # one bias alone may have a mean near zero
    ]
    means = np.array(
        [residuals(rig, table, "image_2").reshape(20, 50, 2).mean(axis=1) for table in drives]
    )
    assert np.mean(means.std(axis=1) ** 2) < 0.25 * np.mean(means.mean(axis=1) ** 2)


def test_stuck_frames_have_the_matches_of_a_displaced_pose() -> None:
    rig = rig_of("kitti")
    errors = MatcherErrors(
        noise_px=0.0, stuck_share=0.5, stuck_pose=PoseSpread((0.5, 0.5, 0.5), (0.1, 0.1, 0.1))
    )
    table = simulate_correspondences(rig, frames=200, matches=30, errors=errors, depth_m=None)
    sizes = np.hypot(*residuals(rig, table, "image_2").T).reshape(200, 30)
    moved = np.median(sizes, axis=1) > 1e-6
    assert 0.36 < moved.mean() < 0.64  # 4 sigma of 200 frames


def test_a_guess_of_the_same_seed_is_independent_of_the_matchers_errors(pair: Rig) -> None:
    """One number seeds both, and generators of [seed, 0] and of seed are the same."""
    pose = PoseSpread((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    errors = MatcherErrors(noise_px=0.0, bias_pose=pose)
    alike = []
    for seed in range(8):
        table = simulate_correspondences(pair, frames=1, matches=200, errors=errors, seed=seed)
        seen = solve_joint(pair, table).solved_rig
        guess = calibgraph.perturb(pair, rotation_deg=0, translation_m=0.1, seed=seed)
        for name, T in pair.T_camera_lidar.items():
            a = seen.T_camera_lidar[name][:3, 3] - T[:3, 3]
            b = guess.T_camera_lidar[name][:3, 3] - T[:3, 3]
            alike.append(abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b))
    assert np.mean(alike) < 0.8  # 0.5 +- 0.07 of independent directions, 1 of equal ones


def test_a_table_of_a_rig_that_sees_all_round_is_solved() -> None:
    rig = rig_of("omni")
    table = simulate_correspondences(rig, frames=5, matches=400)
    result = calibgraph.solve(
        calibgraph.perturb(rig, rotation_deg=5, translation_m=0.3, seed=1), table
    )
    assert result.verdict.status == "PASS"
    # 1 px of 300 px/rad over 2000 matches: 0.2 deg / 45, and as much of 10 m.
    require_near(result.rig, rig, deg=0.03, cm=1.0)


@pytest.mark.slow
@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize("name", ["fisheye", "omni"])
def test_a_rendered_rig_that_sees_all_round_is_calibrated(name: str, tmp_path: Path) -> None:
    """Errors of more frames, from near and far, are in benchmarks/notes/simulation.md."""
    calibgraph.simulate_street(
        tmp_path / "street", rig_of(name), frames=5, seed=3, rotation_deg=8.0, translation_m=0.5
    )
    result = calibgraph.calibrate(tmp_path / "street")
    assert result.verdict.status == "PASS"
    truth = calibgraph.load_rig(tmp_path / "street" / "reference.yaml")
    require_near(result.rig, truth, deg=0.06, cm=1.5)
