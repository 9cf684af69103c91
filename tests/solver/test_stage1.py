"""Poses of frames: of one by itself, of many at once, of many as one, and their weights."""

from collections.abc import Callable
from dataclasses import replace

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
    solve,
)
from calibgraph.graph.objective import projection_graph
from calibgraph.simulation.correspondences import PoseSpread
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver import stage1
from calibgraph.solver.frame_weights import confidence_sigmas, fit_each_frame
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.matches import camera_blocks
from calibgraph.solver.stage1 import T_hat, are_near_median, estimate_stage1, median_pose
from calibgraph.solver.two_pass import optimize
from factors import ProjectionBlock, to_runs

Array = np.ndarray


def poses(rng: np.random.Generator, count: int, sigma: float) -> np.ndarray:
    """Transforms scattered about a known one."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(sigma * rng.standard_normal((count, 3))).as_matrix()
    T[:, :3, 3] = [1, 2, 3] + sigma * rng.standard_normal((count, 3))
    return T


def far_from(rig: Rig) -> Rig:
    """The rig with a guess from which no fit leads to the right poses."""
    return perturb(rig, rotation_deg=90, translation_m=2.0)


def stage1_of(rig: Rig, table: Correspondences) -> stage1.Stage1:
    return estimate_stage1(rig, camera_blocks(rig, table, Config()), Config())


def require_exact(found: stage1.Stage1, rig: Rig) -> None:
    for name, T in rig.T_camera_lidar.items():
        assert found[name].failed_frames == 0
        for pose in found[name].per_frame:
            np.testing.assert_allclose(pose, T, atol=1e-6)


def test_frames_of_lenses_that_see_all_round_are_solved() -> None:
    """By PnP without a guess, from matches of which some lie behind the camera."""
    rig = rig_of("omni")
    errors = MatcherErrors(noise_px=0.0, outlier_share=0.3)
    table = simulate_correspondences(rig, frames=3, matches=200, errors=errors)
    for camera, T in rig.T_camera_lidar.items():
        points = table.of_camera(camera).points_lidar_m
        behind = (points @ T[:3, :3].T + T[:3, 3])[:, 2] < 0
        assert behind.sum() > 0
    require_exact(stage1_of(far_from(rig), table), rig)


def test_magsac_finds_what_a_fit_from_a_near_guess_finds(
    mixed_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = MatcherErrors(noise_px=0.0, outlier_share=0.3)
    table = simulate_correspondences(mixed_rig, frames=4, matches=200, errors=errors)
    require_exact(stage1_of(far_from(mixed_rig), table), mixed_rig)
    monkeypatch.setattr(stage1, "ransac_pnp", None)  # so that a call of it fails
    near = perturb(mixed_rig, rotation_deg=1, translation_m=0.1)
    require_exact(stage1_of(near, table), mixed_rig)


def test_failed_frames_are_counted_and_dropped(pair: Rig) -> None:
    good = simulate_correspondences(pair, frames=5, matches=100)
    few = good.select((good.frame < 4) | (np.arange(len(good)) % 40 == 0))
    found = stage1_of(pair, few)
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
        found = stage1_of(pair, concatenate([left, right]))
        assert list(T_hat(found)) == ["right"]
        assert {name: camera.failed_frames for name, camera in found.items()} == {
            "left": 1,
            "right": 0,
        }


def test_the_geodesic_median_of_rotations_about_one_axis_is_the_median_angle() -> None:
    angles = np.array([-0.3, -0.1, 0.05, 0.4, 1.2])
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, [0, 0, 1])).as_matrix()
    found = Rotation.from_matrix(median_pose(T)[:3, :3]).as_rotvec()
    np.testing.assert_allclose(found, [0, 0, 0.05], atol=1e-6)


def test_stray_frames_are_recognised_without_a_reference() -> None:
    rng = np.random.default_rng(7)
    good, bad = poses(rng, 20, 0.01), poses(rng, 5, 0.5)
    both = np.concatenate([good, bad])
    kept = are_near_median(both)
    # A Gaussian vector in 3 dimensions lies within 6 medians (9 sigma) of its centre.
    assert kept[:20].all() and not kept[20:].any()
    assert are_near_median(np.tile(np.eye(4), (4, 1, 1))).all()
    assert are_near_median(bad[:2]).all()  # of two, none can be said to be the wrong one


def test_every_frame_ends_where_levenberg_marquardt_of_gtsam_does(mixed_rig: Rig) -> None:
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.2)
    table = simulate_correspondences(mixed_rig, frames=5, matches=200, errors=errors)
    guess = perturb(mixed_rig, rotation_deg=0.5, translation_m=0.05)
    for name, camera in guess.cameras.items():
        rows = table.of_camera(name)
        block = ProjectionBlock(camera.lens, rows.points_lidar_m, rows.pixels_px)
        runs = to_runs(np.append(np.unique(rows.frame, return_index=True)[1], len(rows)))
        poses, _, found = block.fit(camera.T_camera_lidar[None], runs, tolerance=1e-10)
        assert found.all()
        for run, T in zip(runs, poses, strict=True):
            alone = projection_graph(["one"], {"one": block.select(np.arange(*run))})
            found = optimize(alone, ["one"], {"one": camera.T_camera_lidar}).T_camera_lidar["one"]
            # Both stop where the cost changes by 1e-10 of itself: 1e-5 of a standard deviation,
            # which is 1e-3 rad and 1e-2 m for 200 matches.
            np.testing.assert_allclose(T, found, atol=1e-7)


STUCK = MatcherErrors(
    noise_px=1.0,
    frame_noise_px=0.3,
    outlier_share=0.2,
    stuck_share=0.6,
    stuck_pose=PoseSpread((0.5, 0.5, 0.5), (0.3, 0.3, 0.6)),
)
GOOD = replace(STUCK, stuck_share=0.0)


def errors_of(rig: Rig, errors: MatcherErrors, *, learnt: bool, seed: int) -> list[float]:
    """Error of every camera [deg], from 20 deg and 1.5 m off, over 20 frames."""
    table = simulate_correspondences(rig, frames=20, matches=300, errors=errors, seed=seed)
    guess = perturb(rig, rotation_deg=20, translation_m=1.5, seed=seed)
    found = solve_joint(guess, table, Config(learnt_weights=learnt)).solved_rig
    return [error.rotation_error_deg for error in evaluate(found, rig).cameras.values()]


@pytest.mark.slow
def test_a_majority_of_frames_that_are_stuck_elsewhere_seldom_decides(pair: Rig) -> None:
    """70 % of frames lie about one wrong pose, 0.5 deg and 0.6 m away; 16 draws of a camera."""
    most = replace(STUCK, stuck_share=0.7)
    wrong = [
        sum(e > 0.1 for seed in range(8) for e in errors_of(pair, most, learnt=learnt, seed=seed))
        for learnt in (True, False)
    ]
    assert wrong[0] <= 3 < wrong[1]


def test_good_frames_all_count(pair: Rig) -> None:
    table = simulate_correspondences(pair, frames=20, matches=300, errors=GOOD)
    found = solve_joint(pair, table)
    for counts in found.counts.values():
        assert counts["outlier_frames"] <= 2
        assert counts["frames"] == 20


def test_frames_with_few_matches_neither_rule_nor_are_called_apart(pair: Rig) -> None:
    """Six unknowns of a frame's own explain three matches exactly: that is not their merit."""
    noise = MatcherErrors(noise_px=1.0, outlier_share=0.0)
    dense = simulate_correspondences(pair, frames=12, matches=300, errors=noise, seed=1)
    sparse = simulate_correspondences(pair, frames=100, matches=3, errors=noise, seed=2)
    table = concatenate([dense, replace(sparse, frame=sparse.frame + 12)])
    learnt = solve_joint(pair, table)
    plain = solve_joint(pair, table, Config(learnt_weights=False))
    for counts in learnt.counts.values():
        assert counts["outlier_frames"] <= 3
    worst = [
        max(e.rotation_error_deg for e in evaluate(found.solved_rig, pair).cameras.values())
        for found in (learnt, plain)
    ]
    assert worst[0] < 1.3 * worst[1] + 0.001


def test_a_minority_that_decides_is_worth_a_warning(pair: Rig) -> None:
    errors = replace(STUCK, stuck_share=0.75)
    table = simulate_correspondences(pair, frames=30, matches=200, errors=errors, seed=3)
    result = solve(pair, table)
    apart = [counts["outlier_frames"] / counts["frames"] for counts in result.counts.values()]
    assert max(apart) > 0.35
    assert result.verdict.status != "PASS"
    assert any("outlier frames" in reason for reason in result.verdict.reasons)


def sigmas_learnt(sizes_of: Callable[[Array, Array], Array], count: int) -> tuple[Array, Array]:
    """Confidences of 0 to 1, and the sigmas learnt from residuals of such sizes [px]."""
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0, 1, count)
    noise = np.hypot(*rng.standard_normal((2, count))) / 1.17741  # its median is 1
    return confidence, confidence_sigmas(sizes_of(confidence, noise), confidence)


@pytest.mark.parametrize(("outliers", "least", "median"), [(0.7, 0.3, 1.1), (0.9, 50.0, 400.0)])
def test_a_few_matches_that_fit_exactly_make_no_frame_precise(
    outliers: float, least: float, median: float
) -> None:
    """Noise is 1 px. Of 30 matches with 27 outliers, some pose always fits seven to 0.1 px."""
    rig, errors = rig_of("kitti"), MatcherErrors(noise_px=1.0, outlier_share=outliers)
    table = simulate_correspondences(rig, frames=100, matches=30, errors=errors, seed=1)
    for name, block in camera_blocks(rig, table, Config()).items():
        T = rig.cameras[name].T_camera_lidar
        starts = [perturb(rig, rotation_deg=3, translation_m=0.3, seed=k) for k in range(100)]
        own = np.array([start.cameras[name].T_camera_lidar for start in starts])
        spreads = fit_each_frame(block, own, T, most_px=10.0).spreads
        assert spreads.min() > least
        assert np.median(spreads) < median


def test_what_confidences_are_worth_is_learnt() -> None:
    """1 px at confidence 1, 4 px at 0: within the scatter of spreads of 1000 matches, 3 %."""
    confidence, learnt = sigmas_learnt(lambda c, noise: (4.0 - 3.0 * c) * noise, 20_000)
    ratio = learnt / (4.0 - 3.0 * confidence)
    inner = (confidence > 0.05) & (confidence < 0.95)
    np.testing.assert_allclose(ratio[inner], np.median(ratio), rtol=0.12)


def test_confidences_that_say_nothing_are_not_believed_and_none_counts_the_wrong_way() -> None:
    _, learnt = sigmas_learnt(lambda _, noise: noise, 20_000)
    assert learnt.max() / learnt.min() < 1.1
    confidence, learnt = sigmas_learnt(lambda c, noise: (1 + c) * noise, 5000)
    assert (np.diff(learnt[np.argsort(confidence)]) <= 1e-12).all()
    for count in (0, 10, 199):  # few matches are alike
        np.testing.assert_array_equal(sigmas_learnt(lambda _, noise: noise, count)[1], 1.0)
