from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calibgraph import (
    Config,
    CorrespondenceError,
    Correspondences,
    MatcherErrors,
    Rig,
    concatenate,
    evaluate,
    perturb,
    preset,
    simulate_correspondences,
    solve,
)
from calibgraph.model.config import TERMS
from calibgraph.model.findings import error_components
from calibgraph.solver import two_pass
from calibgraph.solver.joint import require_in_reach, solve_joint
from calibgraph.trust.thresholds import threshold
from tests.conftest import make_camera, make_pair, require_near, stereo_relative_pose

CLEAN = MatcherErrors(noise_px=0.0)
NOISY = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.15)


def test_recovers_truth_without_noise(mixed_rig: Rig) -> None:
    table = simulate_correspondences(mixed_rig, errors=CLEAN, frames=6, matches=200)
    start = perturb(mixed_rig, rotation_deg=2, translation_m=0.2)
    # Without its priors: the relative prior would pull towards Stage 1, however exact.
    result = solve(start, table, terms="reprojection")
    require_near(result.rig, mixed_rig, deg=1e-5, cm=1e-4)


def test_recovers_truth_from_noise_and_poisoned_outliers(mixed_rig: Rig) -> None:
    table = simulate_correspondences(mixed_rig, errors=NOISY, frames=20, matches=300)
    # Poison: outliers (the unconfident ones) say something absurd; any use of them would show.
    poison = table.confidence < 0.4
    pixels = table.pixels_px.copy()
    pixels[poison] = 3.0
    table = replace(table, pixels_px=pixels, confidence=np.ones_like(table.confidence))
    start = perturb(mixed_rig, rotation_deg=2, translation_m=0.2)
    result = solve(start, table, Config(common_deg=0.0, common_cm=0.0))
    for name, error in evaluate(result.rig, mixed_rig).cameras.items():
        degrees, centimetres = result.sigmas(name)
        assert error.rotation_error_deg < 4 * np.linalg.norm(degrees)
        assert error.translation_error_cm < 4 * np.linalg.norm(centimetres)
        # The spread of the residuals is the noise that went in: 1 px and 0.5 px, independent.
        assert result.residuals[name].sigma_px == pytest.approx(np.hypot(1.0, 0.5), rel=0.15)
    assert result.verdict.status == "PASS"


@pytest.mark.parametrize("terms", TERMS)
@pytest.mark.parametrize("name", ["kitti", "walkley", "auto"])
def test_every_configuration_and_preset_calibrates(pair: Rig, terms: str, name: str) -> None:
    table = simulate_correspondences(pair, errors=NOISY, frames=8, matches=200)
    start = perturb(pair, rotation_deg=2, translation_m=0.2)
    result = solve(start, table, preset(name), terms)
    require_near(result.rig, pair, deg=0.2, cm=5)
    assert result.terms == terms
    assert result.config.preset == name
    assert (result.joint_covariance is None) == (terms in ("stage1", "priors"))


def test_the_gate_drops_what_exceeds_it(pair: Rig) -> None:
    table = simulate_correspondences(pair, errors=NOISY, frames=8, matches=300)
    result = solve(perturb(pair, rotation_deg=1, translation_m=0.1), table, preset("kitti"))
    for name, counts in result.counts.items():
        assert counts["used"] < counts["capped"]
        # Inside 3 px: most of the 85 % with noise of 1.1 px, and few of the others.
        assert 0.75 < result.residuals[name].inlier_share < 0.9


def test_a_camera_without_correspondences_is_solved_through_a_relative_pose(pair: Rig) -> None:
    table = simulate_correspondences(pair, errors=CLEAN, frames=6).of_camera("left")
    rig = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    result = solve(perturb(rig, rotation_deg=2, translation_m=0.2), table)
    require_near(result.rig, pair, deg=1e-3, cm=0.1)
    assert result.camera_verdicts["right"].status == "WARN"
    assert "right" not in result.residuals


def test_too_few_correspondences_are_counted_with_their_camera(pair: Rig) -> None:
    table = simulate_correspondences(pair, frames=3)
    left, right = table.of_camera("left"), table.of_camera("right")
    about = np.diag([-1.0, 1.0, -1.0, 1.0])  # turned to look backwards
    backwards = pair.moved_to({n: about @ T for n, T in pair.T_camera_lidar.items()})
    for rig, given, message in (
        (pair, left, r"camera 'right' has 0 usable"),
        (pair, concatenate([left, right.select(slice(0, 5))]), r"camera 'right' has 5 usable"),
        (backwards, table, r"0 usable.*1500 given, 0 projectable.*axes"),
    ):
        with pytest.raises(CorrespondenceError, match=message):
            solve(rig, given)


def test_an_independent_relative_pose_is_honoured(pair: Rig) -> None:
    """One camera with poor matches, one with good ones, tied by a stereo calibration."""
    good = simulate_correspondences(pair, errors=MatcherErrors(noise_px=0.3), seed=1)
    poor = simulate_correspondences(pair, errors=MatcherErrors(noise_px=20.0), matches=30, seed=2)
    table = concatenate([good.of_camera("left"), poor.of_camera("right")])
    tied = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    alone, together = (solve(rig, table, terms="reprojection") for rig in (pair, tied))
    errors = [evaluate(r.rig, pair).cameras["right"] for r in (alone, together)]
    assert errors[1].translation_error_cm < 0.5 < errors[0].translation_error_cm
    pairs = [evaluate(r.rig, pair).pairs["left->right"] for r in (alone, together)]
    assert pairs[1].rotation_error_deg < np.degrees(4e-3) < pairs[0].rotation_error_deg


@pytest.fixture(scope="module")
def three() -> Rig:
    """Left and right, and a third camera beside them."""
    return Rig(cameras={**make_pair().cameras, "third": make_camera((0.3, -0.9, -0.1))})


def exp(*xi: float) -> np.ndarray:
    return gtsam.Pose3.Expmap(np.array(xi)).matrix()


@pytest.mark.parametrize(
    ("wrong", "status"),
    [
        (lambda T: T, "PASS"),
        (lambda T: exp(0, 0, 0, 0.05, 0, 0) @ T, "FAIL"),
        (np.linalg.inv, "FAIL"),
        (lambda T: T @ exp(0, np.radians(30), 0, 0, 0, 0), "FAIL"),  # as if cameras were exchanged
    ],
    ids=["right", "5 cm off", "inverted", "30 deg off"],
)
def test_a_relative_pose_that_contradicts_the_data_is_named_and_moves_no_camera(
    three: Rig, wrong: Callable[[np.ndarray], np.ndarray], status: str
) -> None:
    table = simulate_correspondences(three, errors=NOISY, frames=12)
    measured = stereo_relative_pose(three)
    measured = measured.model_copy(update={"T_a_b": wrong(measured.T_a_b)})
    pairs = (measured, stereo_relative_pose(three, "right", "third"))
    guess = perturb(three, rotation_deg=1.0, translation_m=0.05, seed=1)
    result = solve(guess.model_copy(update={"relative_poses": pairs}), table)
    require_near(result.rig, three, deg=0.05, cm=np.inf)
    assert result.verdict.status == status
    for name in ("left", "right"):
        verdict = result.camera_verdicts[name]
        named = any("relative pose of left and right" in reason for reason in verdict.reasons)
        assert (verdict.status, named) == (status, status == "FAIL")
    assert result.camera_verdicts["third"].status != "FAIL"


def test_the_limit_of_a_contradiction_is_that_of_the_verdict() -> None:
    assert error_components().contradiction_sigmas == threshold("relative_pose").fail


def test_points_on_one_line_are_not_passed(pair: Rig) -> None:
    """The rotation about the line is known from the prior alone, and no scatter shows it."""
    rng = np.random.default_rng(0)
    tables = []
    for name, camera in pair.cameras.items():
        T = camera.T_camera_lidar
        for frame in range(8):
            line = [0.0, 0.0, 8.0] + rng.uniform(-2, 2, (200, 1)) * [1.0, 0.1, 0.3]
            pixels = camera.lens.project(line)[0] + 0.5 * rng.standard_normal((200, 2))
            tables.append(
                Correspondences.from_arrays(
                    camera=name,
                    frame=frame,
                    pixels_px=pixels,
                    points_lidar_m=(line - T[:3, 3]) @ T[:3, :3],
                )
            )
    result = solve(perturb(pair, rotation_deg=2, translation_m=0.2), concatenate(tables))
    assert result.verdict.status == "FAIL"
    assert any("leave directions of the pose free" in reason for reason in result.verdict.reasons)


def test_an_error_that_all_frames_share_is_in_the_error_bar(pair: Rig) -> None:
    table = simulate_correspondences(pair, errors=NOISY, frames=8)
    metadata = {"systematic_rotation_rad": 1e-3, "systematic_translation_m": 0.02}
    plain, honest = (solve(pair, t) for t in (table, replace(table, metadata=metadata)))
    added = honest.covariance["left"] - plain.covariance["left"]
    half = np.diag([1e-6] * 3 + [4e-4] * 3) / 2  # of the camera, and of the cloud about the LiDAR
    turned = gtsam.Pose3(honest.T_camera_lidar["left"]).AdjointMap()
    expected = half + turned @ half @ turned.T
    # The weak priors, of a metre, take a thousandth (2 cm / 1 m, squared, and that of 30 cm) off.
    np.testing.assert_allclose(added, expected, rtol=2e-3, atol=5e-9)
    for wrong in (-1.0, "much", np.inf):
        with pytest.raises(CorrespondenceError, match="systematic_translation_m"):
            solve(pair, replace(table, metadata={"systematic_translation_m": wrong}))


def test_seven_of_ten_outliers_and_a_guess_20_deg_off_are_survived(mixed_rig: Rig) -> None:
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.7, informative_confidence=False)
    for seed in range(2):
        table = simulate_correspondences(mixed_rig, matches=300, errors=errors, seed=seed)
        start = perturb(mixed_rig, rotation_deg=20, translation_m=1.5, seed=seed)
        result = solve(start, table)
        require_near(result.rig, mixed_rig, deg=0.1, cm=3)
        assert result.residuals["front"].sigma_px == pytest.approx(1.0, rel=0.1)


def test_without_pnp_a_narrowing_loss_leads_to_where_matches_are_densest(
    pair: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From 20 deg and 1.5 m off, with the guess as Stage 1 and 70 % outliers."""
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.7)
    table = simulate_correspondences(pair, frames=5, matches=300, errors=errors)
    start = perturb(pair, rotation_deg=20, translation_m=1.5)
    found = solve_joint(start, table, Config(stage1="rig"))
    require_near(found.solved_rig, pair, deg=0.1, cm=5)
    monkeypatch.setattr(two_pass, "_NARROWINGS", 0)
    stuck = solve_joint(start, table, Config(stage1="rig")).solved_rig
    assert max(e.rotation_error_deg for e in evaluate(stuck, pair).cameras.values()) > 1


def test_information_along_an_edge_is_used_and_across_it_is_not(pair: Rig) -> None:
    """Matches that know only one direction, and are nonsense along the other."""
    table = simulate_correspondences(pair, errors=CLEAN, frames=10, matches=400)
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, np.pi, len(table))
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    along = np.column_stack([-normal[:, 1], normal[:, 0]])
    pixels = table.pixels_px + along * rng.uniform(-8, 8, len(table))[:, None]
    information = np.column_stack([normal[:, 0] ** 2, normal.prod(axis=1), normal[:, 1] ** 2])
    edges = replace(table, pixels_px=pixels, information_px=information)
    config = Config(stage1="rig")  # PnP on single frames treats such matches as points
    result = solve(perturb(pair, rotation_deg=1, translation_m=0.1), edges, config)
    require_near(result.rig, pair, deg=1e-3, cm=1e-2)
    assert result.residuals["left"].median_px < 0.01


def test_an_extrinsic_that_no_rig_holds_is_refused_with_its_camera() -> None:
    T = np.eye(4)
    require_in_reach({"left": T})
    T[0, 3] = -2e6
    with pytest.raises(CorrespondenceError, match=r"camera 'left': .* 2e\+06 m away") as error:
        require_in_reach({"left": T})
    assert error.value.camera == "left"
