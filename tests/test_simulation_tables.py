"""Simulated correspondences: errors as asked for, named scenarios, the command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.simulation.correspondences import PoseSpread
from calibgraph.simulation.rigs import RIG_NAMES, rig_of
from calibgraph.simulation.scenarios import SCENARIOS, scenario_of
from tests.conftest import Call


def residuals(rig: Rig, table: Correspondences, name: str) -> np.ndarray:
    """(n, 2) observed minus true pixels."""
    rows, camera = table.of_camera(name), rig.cameras[name]
    T = camera.T_camera_lidar
    pixels, _ = camera.lens.project(rows.points_lidar_m @ T[:3, :3].T + T[:3, 3])
    return np.asarray(rows.pixels_px - pixels)


@pytest.mark.parametrize("name", RIG_NAMES)
def test_points_of_a_street_lie_in_the_image_and_before_walls(name: str) -> None:
    rig = rig_of(name)
    still = MatcherErrors(noise_px=0.0)
    table = simulate_correspondences(rig, frames=2, matches=300, errors=still, depth_m=None)
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
    table = simulate_correspondences(rig, frames=20, matches=50, errors=same, depth_m=None)
    means = residuals(rig, table, "image_2").reshape(20, 50, 2).mean(axis=1)
    assert means.std(axis=0).max() < 0.5 * np.abs(means.mean(axis=0)).max()


def test_stuck_frames_have_the_matches_of_a_displaced_pose() -> None:
    rig = rig_of("kitti")
    errors = MatcherErrors(
        noise_px=0.0, stuck_share=0.5, stuck_pose=PoseSpread((0.5, 0.5, 0.5), (0.1, 0.1, 0.1))
    )
    table = simulate_correspondences(rig, frames=200, matches=30, errors=errors, depth_m=None)
    sizes = np.hypot(*residuals(rig, table, "image_2").T).reshape(200, 30)
    moved = np.median(sizes, axis=1) > 1e-6
    assert 0.36 < moved.mean() < 0.64  # 4 sigma of 200 frames


def test_confidences_fall_with_the_noise_unless_they_say_nothing() -> None:
    rig = rig_of("kitti")
    for informative in (True, False):
        errors = MatcherErrors(noise_spread=1.0, informative_confidence=informative)
        table = simulate_correspondences(rig, frames=5, matches=1000, errors=errors, depth_m=None)
        sizes = np.hypot(*residuals(rig, table, "image_2").T)
        confidence = table.of_camera("image_2").confidence
        correlation = np.corrcoef(np.log(sizes), confidence)[0, 1]
        assert correlation < -0.2 if informative else abs(correlation) < 0.06  # 4 sigma of 5000


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_command_writes_a_table_that_can_be_solved(
    name: str, tmp_path: Path, call: Call
) -> None:
    folder = tmp_path / "sim"
    code, _, text = call("simulate", name, "--frames", 3, "--out", folder)
    assert code == 0, text
    table = calibgraph.load_correspondences(folder / "correspondences.parquet")
    truth = calibgraph.load_rig(folder / "reference.yaml")
    assert set(table.cameras) == set(truth.cameras) == set(scenario_of(name).rig.cameras)
    for name_, error in calibgraph.evaluate(
        calibgraph.load_rig(folder / "rig.yaml"), truth
    ).cameras.items():
        assert error.rotation_error_deg == pytest.approx(5, abs=1e-6), name_
    code, _, text = call("simulate", name, "--frames", 3, "--out", folder)
    assert code == 2 and "is there already" in text
    again = scenario_of(name).draw(3, 0)
    np.testing.assert_array_equal(again.pixels_px, table.pixels_px)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere",), "unknown scenario 'nowhere'; known are street, kitti"),
        (("kitti", "--frames", 0), "0 frames: expected 1 to"),
        (("walkley", "--rotation-deg", 200), "expected an angle within"),
        (("kitti", "--beams", 16, "--rig", "fisheye"), "--rig and --beams would change nothing"),
        (("walkley", "--step-m", 0), "--step-m would change nothing"),
        (("nowhere", "--beams", 16), "unknown scenario 'nowhere'"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: tuple[object, ...], words: str, tmp_path: Path, call: Call
) -> None:
    code, _, text = call("simulate", *arguments, "--out", tmp_path / "out")
    assert code == 2 and words in text and len(text.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
