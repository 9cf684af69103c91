from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibgraph import (
    Config,
    Correspondences,
    MatcherErrors,
    Rig,
    concatenate,
    evaluate,
    perturb,
    simulate_correspondences,
)
from calibgraph.model.geometry import pose_difference
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver import stage1
from calibgraph.solver.geodesic_median import geodesic_median
from calibgraph.solver.pnp import frame_pose, view_plane
from calibgraph.solver.stage1 import (
    T_hat,
    are_near_median,
    estimate_stage1,
)


def poses(rng: np.random.Generator, count: int, sigma: float) -> np.ndarray:
    """Transforms scattered about a known one."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(sigma * rng.standard_normal((count, 3))).as_matrix()
    T[:, :3, 3] = [1, 2, 3] + sigma * rng.standard_normal((count, 3))
    return T


def test_undistorting_inverts_every_lens(mixed_rig: Rig) -> None:
    rng = np.random.default_rng(0)
    for name, camera in mixed_rig.cameras.items():
        plane = rng.uniform(-0.6, 0.6, (200, 2)) * [1.2, 0.4]
        pixels, _ = camera.lens.project(np.column_stack([plane, np.ones(200)]))
        np.testing.assert_allclose(view_plane(camera, pixels)[1], plane, atol=1e-7, err_msg=name)


def test_every_frame_is_solved_without_noise(mixed_rig: Rig) -> None:
    table = simulate_correspondences(
        mixed_rig, frames=4, matches=100, errors=MatcherErrors(noise_px=0.0)
    )
    found = estimate_stage1(mixed_rig, table, Config())
    for name, T in mixed_rig.T_camera_lidar.items():
        assert found[name].failed_frames == 0
        for pose in found[name].per_frame:
            np.testing.assert_allclose(pose, T, atol=1e-6)


@pytest.mark.parametrize("name", ["omni", "panorama"])
def test_frames_of_lenses_that_see_all_round_are_solved(name: str) -> None:
    """By PnP without a guess, from matches of which many lie behind the camera."""
    rig = rig_of(name)
    errors = MatcherErrors(noise_px=0.0, outlier_share=0.3)
    table = simulate_correspondences(rig, frames=3, matches=200, errors=errors)
    for camera, T in rig.T_camera_lidar.items():
        points = table.of_camera(camera).points_lidar_m
        behind = (points @ T[:3, :3].T + T[:3, 3])[:, 2] < 0
        assert behind.sum() > (250 if name == "panorama" else 0)
        found = estimate_stage1(far_from(rig), table, Config())[camera]
        assert found.failed_frames == 0
        for pose in found.per_frame:
            np.testing.assert_allclose(pose, T, atol=1e-6)


def far_from(rig: Rig) -> Rig:
    """The rig with a guess from which no fit leads to the right poses."""
    return perturb(rig, rotation_deg=90, translation_m=2.0)


def test_magsac_finds_what_a_fit_from_a_near_guess_finds(
    mixed_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = MatcherErrors(noise_px=0.0, outlier_share=0.3)
    table = simulate_correspondences(mixed_rig, frames=4, matches=200, errors=errors)
    by_magsac = estimate_stage1(far_from(mixed_rig), table, Config())
    monkeypatch.setattr(stage1, "ransac_pnp", None)  # so that a call of it fails
    near = perturb(mixed_rig, rotation_deg=1, translation_m=0.1)
    for found in (by_magsac, estimate_stage1(near, table, Config())):
        for name, T in mixed_rig.T_camera_lidar.items():
            assert found[name].failed_frames == 0
            for pose in found[name].per_frame:
                np.testing.assert_allclose(pose, T, atol=1e-6)


def test_outliers_do_not_spoil_a_frame(pair: Rig) -> None:
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.4)
    table = simulate_correspondences(pair, frames=6, matches=300, errors=errors)
    found = estimate_stage1(pair, table, Config())
    estimate = pair.moved_to(T_hat(found))
    for error in evaluate(estimate, pair).cameras.values():
        assert error.rotation_error_deg < 0.05
        assert error.translation_error_cm < 2


def test_failed_frames_are_counted_and_dropped(pair: Rig) -> None:
    good = simulate_correspondences(pair, frames=5, matches=100)
    few = good.select((good.frame < 4) | (np.arange(len(good)) % 40 == 0))
    found = estimate_stage1(pair, few, Config())
    assert {name: camera.failed_frames for name, camera in found.items()} == {"left": 1, "right": 1}
    assert len(found["left"].per_frame) == 4


def test_matches_that_leave_a_direction_free_give_no_pose(pair: Rig) -> None:
    table = simulate_correspondences(pair, frames=1, matches=50, errors=MatcherErrors(noise_px=0.0))
    right = table.of_camera("right")
    camera = pair.cameras["left"]
    T = camera.T_camera_lidar
    line = np.outer(np.linspace(5, 50, 50), [0.1, 0.05, 1.0]) + [0.0, 0.2, 0.0]
    on_a_line = Correspondences.from_arrays(
        camera="left",
        frame=0,
        pixels_px=camera.lens.project(line)[0],
        points_lidar_m=(line - T[:3, 3]) @ T[:3, :3],
    )
    for left in (on_a_line, on_a_line.select(np.zeros(50, np.intp))):  # and in one place
        found = estimate_stage1(pair, concatenate([left, right]), Config())
        assert list(T_hat(found)) == ["right"]
        assert {name: camera.failed_frames for name, camera in found.items()} == {
            "left": 1,
            "right": 0,
        }


def test_the_geodesic_median_of_rotations_about_one_axis_is_the_median_angle() -> None:
    angles = np.array([-0.3, -0.1, 0.05, 0.4, 1.2])
    rotations = Rotation.from_rotvec(np.outer(angles, [0, 0, 1]))
    np.testing.assert_allclose(geodesic_median(rotations).as_rotvec(), [0, 0, 0.05], atol=1e-6)


def test_stray_frames_are_recognised_without_a_reference() -> None:
    rng = np.random.default_rng(7)
    good, bad = poses(rng, 20, 0.01), poses(rng, 5, 0.5)
    both = np.concatenate([good, bad])
    kept = are_near_median(both)
    # A Gaussian vector in 3 dimensions lies within 6 medians (9 sigma) of its centre.
    assert kept[:20].all() and not kept[20:].any()
    assert are_near_median(np.tile(np.eye(4), (4, 1, 1))).all()
    assert are_near_median(bad[:2]).all()  # of two, none can be said to be the wrong one


def test_the_common_start_gives_each_frame_the_pose_of_its_own_search(mixed_rig: Rig) -> None:
    errors = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.3)
    table = simulate_correspondences(mixed_rig, frames=6, matches=300, errors=errors)
    found = estimate_stage1(mixed_rig, table, Config())
    for name, camera in mixed_rig.cameras.items():
        rows = table.of_camera(name)
        for number, T in found[name].by_frame.items():
            alone = frame_pose(camera, rows.select(rows.frame == number), Config())
            assert alone is not None
            degrees, centimetres = pose_difference(T, alone)
            # A match at the edge of the threshold may be in the one and not in the other: its pull
            # is that of 8 px, eight standard deviations, on one of 200 inliers.
            assert degrees < 0.01 and centimetres < 0.5
