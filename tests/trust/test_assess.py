from __future__ import annotations

import re

import gtsam
import numpy as np
import pytest

import calibgraph
from calibgraph import (
    Calibration,
    Camera,
    Check,
    Config,
    Correspondences,
    MatcherErrors,
    Rig,
    Verdict,
    concatenate,
    simulate_correspondences,
    solve,
)
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import relative_covariance
from calibgraph.model.verdict import above, below, rig_verdict
from calibgraph.solver.covariance import with_pseudo_frames
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.cross_validation import competing_solution_check
from calibgraph.trust.guess import (
    OPTICAL_FROM_BODY,
    guess_checks,
    nearest_reading,
    readings,
    swap_check,
)
from calibgraph.trust.observability import weakest_direction
from tests.conftest import make_camera, stereo_relative_pose

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def simulated(rig: Rig, **settings: object) -> Correspondences:
    return simulate_correspondences(
        rig, **{"frames": 12, "matches": 150, "errors": ERRORS, **settings}
    )


def named(result: Calibration, camera: str, words: str) -> list[Check]:
    return [c for c in result.camera_verdicts[camera].checks if words in f"{c.name} {c.text}"]


def with_lens(rig: Rig, distortion: tuple[float, ...] = (), **changes: float) -> Rig:
    """The rig with intrinsics multiplied (fx, fy) or shifted (cx, cy)."""
    cameras = {}
    for name, camera in rig.cameras.items():
        k = camera.intrinsics_px
        lens = {
            "fx": k.fx * changes.get("focal", 1.0),
            "fy": k.fy * changes.get("focal", 1.0),
            "cx": k.cx + changes.get("cx", 0.0),
            "cy": k.cy,
        }
        given = {**camera.model_dump(), "intrinsics_px": lens}
        cameras[name] = Camera.model_validate({**given, "distortion": distortion})
    return rig.model_copy(update={"cameras": cameras})


class TestChecks:
    def test_the_worst_check_decides_and_its_reason_comes_first(self) -> None:
        verdict = Verdict(
            (above("a", 2, 1, 3, "m"), above("b", 0, 1, 3, "m"), below("c", 0, 2, 1, ""))
        )
        assert verdict.status == "FAIL"
        assert [reason[0] for reason in verdict.reasons] == ["c", "a"]
        assert rig_verdict({"front": verdict}).reasons[0] == "front: c 0 is below 1"

    @pytest.mark.parametrize("check", [above, below])
    def test_nan_fails(self, check: object) -> None:
        assert check("a", float("nan"), 1, 2, "m").status == "FAIL"

    def test_a_number_at_the_threshold_does_not_contradict_itself(self) -> None:
        assert below("kept", 0.59999, 0.6, 0.3, "share").text == "kept 59.999% is below 60%"
        assert above("x", 1.0, 1.0, 2.0, "m").status == "PASS"

    def test_every_threshold_is_written_and_read_again(self, pair: Rig, tmp_path: object) -> None:
        result = solve(pair, simulated(pair), Config(bootstrap=5))
        result.save(tmp_path)
        loaded = calibgraph.load_calibration(tmp_path)
        assert loaded.camera_verdicts == result.camera_verdicts
        assert loaded.weaknesses == result.weaknesses and loaded.prior_share == result.prior_share
        for name, covariance in result.bootstrap.items():
            np.testing.assert_allclose(loaded.bootstrap[name], covariance)
        for name, covariance in result.pair_covariance.items():
            np.testing.assert_allclose(loaded.pair_covariance[name], covariance)

    def test_a_changed_lens_is_not_the_old_one(self, pair: Rig) -> None:
        camera = pair.cameras["left"]
        other = camera.model_copy(update={"distortion": (-0.3, 0.1, 0.0, 0.0)})
        point = np.array([[1.0, 0.5, 4.0]])
        assert np.abs(other.lens.project(point)[0] - camera.lens.project(point)[0]).max() > 1
        assert camera.moved_to(np.eye(4)).lens is camera.lens


class TestCovariance:
    def test_pseudo_frames_add_the_scatter_without_its_correlations(self) -> None:
        rng = np.random.default_rng(0)
        hessian = np.diag([4.0, 3.0, 2.0, 1.0])
        gradients = rng.standard_normal((10, 4)) @ rng.standard_normal((4, 4))
        scatter = gradients.T @ gradients
        found = with_pseudo_frames(scatter, hessian, np.full(4, 10.0))
        np.testing.assert_allclose(found, scatter + 0.8 * np.diag(np.diag(scatter)))

    def test_it_has_full_rank_with_fewer_frames_than_numbers(self, mixed_rig: Rig) -> None:
        result = solve(mixed_rig, simulated(mixed_rig, frames=5))
        assert result.joint_covariance is not None
        assert np.linalg.eigvalsh(result.joint_covariance)[0] > 0

    def test_of_a_pair_is_what_small_steps_of_both_cameras_do(self, pair: Rig) -> None:
        rng = np.random.default_rng(1)
        root = 1e-4 * rng.standard_normal((12, 12))
        left, right = (gtsam.Pose3(T) for T in pair.T_camera_lidar.values())
        T_right_left = right.compose(left.inverse())
        steps = rng.standard_normal((4000, 12)) @ root.T
        twists = [
            gtsam.Pose3.Logmap(
                gtsam.Pose3.Expmap(s[6:]).compose(right)
                .compose(gtsam.Pose3.Expmap(s[:6]).compose(left).inverse())
                .compose(T_right_left.inverse())
            )
            for s in steps
        ]  # fmt: skip
        expected = np.cov(np.array(twists), rowvar=False)
        found = relative_covariance(root @ root.T, 0, 1, T_right_left.matrix())
        ratio = np.linalg.eigvals(np.linalg.solve(expected, found)).real
        # A covariance from n draws is off by sqrt(2 / n), 2.2 %, per direction: 4 of these.
        np.testing.assert_allclose(ratio, 1.0, atol=0.09)

    def test_too_few_frames_give_no_number(self, pair: Rig) -> None:
        result = solve(pair, simulated(pair, frames=4))
        assert result.covariance == {"left": None, "right": None}
        assert not result.pair_covariance and result.sigmas("left->right") is None
        assert any("too few to give an error bar" in reason for reason in result.verdict.reasons)

    def test_the_bootstrap_agrees(self, pair: Rig) -> None:
        config = Config(bootstrap=100)
        table = simulated(pair, frames=30)
        result, again = solve(pair, table, config), solve(pair, table, config)
        for name, covariance in result.bootstrap.items():
            np.testing.assert_array_equal(covariance, again.bootstrap[name])
            ratio = np.sqrt(np.diag(covariance) / np.diag(result.covariance[name]))
            # Of the reported variance 8 / 38 stand for what 30 frames leave unsaid; 100 draws give
            # a standard deviation to 7 %.
            assert (ratio > 0.65).all() and (ratio < 1.15).all()
            (check,) = named(result, name, "bootstrap")
            assert check.status == "PASS" and check.value == pytest.approx(ratio.max())

    def test_without_being_asked_nothing_is_drawn(self, pair: Rig) -> None:
        assert not solve(pair, simulated(pair)).bootstrap


class TestWeakness:
    def test_the_weakest_direction_is_named(self) -> None:
        sigmas = np.array([1e-4, 1e-4, 1e-4, 0.001, 0.001, 0.038])
        assert weakest_direction(np.diag(sigmas**2)) == (
            "shift along z (the optical axis) 3.8 cm (1 sigma)"
        )

    def test_a_mixed_direction_is_told_with_both_parts(self) -> None:
        together = np.array([0, np.radians(0.3), 0, 0.1, 0, 0])
        words = weakest_direction(np.outer(together, together) + 1e-10 * np.eye(6))
        assert (
            words
            == "shift along x (right) 10 cm and turn about y (yaw) 0.3 deg (1 sigma, together)"
        )

    def test_empty_parts_are_told(self, pair: Rig) -> None:
        table = simulated(pair, depth_m=(9.0, 14.0))
        right = table.select(table.pixels_px[:, 0] > 500)
        words = "; ".join(solve(pair, right).weaknesses["left"])
        assert "the left third of the image has no matches" in words
        assert "nothing nearer than 9" in words and "nothing farther than 14 m" in words
        assert "middle third" not in words and "hard to tell apart" in words

    def test_good_data_have_no_empty_parts(self, pair: Rig) -> None:
        (words,) = solve(pair, simulated(pair)).weaknesses["left"]
        assert words.startswith("weakest direction, by the scatter of the frames: ")

    def test_the_share_of_the_priors_is_what_they_hold(self, pair: Rig) -> None:
        table = simulated(pair)
        assert solve(pair, table, terms="reprojection").prior_share["left"] == 0
        strong = solve(pair, table, Config(prior_weight=1e12))
        assert strong.prior_share["left"] > 0.99
        assert named(strong, "left", "share of the priors")[0].status == "WARN"

    def test_a_camera_without_matches_is_all_prior(self, pair: Rig) -> None:
        rig = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
        result = solve(rig, simulated(rig).of_camera("left"))
        assert result.prior_share["right"] == pytest.approx(1.0)
        assert result.prior_share["left"] < 0.01


class TestTrials:
    def test_good_data_pass_every_trial(self, pair: Rig) -> None:
        result = solve(pair, simulated(pair))
        assert result.verdict.status == "PASS", result.verdict.reasons
        for words in ("held-out", "starts 2 deg", "another extrinsic", "distance from the guess"):
            assert named(result, "left", words), words

    def test_a_second_opinion_of_the_matches_is_found(self, pair: Rig) -> None:
        """60 % agree on a wrong extrinsic, 40 % on the right one, which the check names."""
        wrong = calibgraph.perturb(pair, rotation_deg=3, translation_m=0.3, seed=2)
        one, two = simulated(pair, matches=80), simulated(wrong, matches=120, seed=1)
        two = calibgraph.Correspondences(**{**vars(two), "points_lidar_m": two.points_lidar_m})
        result = solve(pair, concatenate([one, two]))
        (check,) = named(result, "left", "another extrinsic")
        assert check.status == "FAIL" and "the other is 3 deg" in check.text

    def test_random_outliers_are_no_second_opinion(self, pair: Rig) -> None:
        errors = MatcherErrors(outlier_share=0.5)
        solved = solve_joint(pair, simulated(pair, errors=errors))
        assert competing_solution_check(solved, "left").value < 0.1

    def test_held_out_frames_tell_too_few_matches(self, pair: Rig) -> None:
        """Two frames of 8 matches: 16 residuals take 6 numbers; the other frame pays for it."""
        errors = MatcherErrors(noise_px=2.0)
        result = solve(pair, simulated(pair, frames=2, matches=8, errors=errors))
        assert named(result, "left", "held-out")[0].value > 1.5

    def test_a_camera_thrown_round_by_contradictions_is_one_line(self, pair: Rig) -> None:
        solved = solve_joint(pair, simulated(pair))
        backwards = {
            name: np.diag([-1.0, 1, -1, 1]) @ T for name, T in solved.T_camera_lidar.items()
        }
        with pytest.raises(calibgraph.CorrespondenceError, match="'left': all its .* are behind"):
            solved.objective.scales_at(backwards)


class TestSmells:
    def test_right_intrinsics_do_not_smell(self, mixed_rig: Rig) -> None:
        result = solve(mixed_rig, simulated(mixed_rig))
        for name in mixed_rig.cameras:
            checks = named(result, name, "residuals over the image")
            assert [check.status for check in checks] == ["PASS"] * 3

    @pytest.mark.parametrize("factor", [0.95, 1.03])
    def test_a_wrong_focal_length_fails_and_is_measured(self, pair: Rig, factor: float) -> None:
        result = solve(with_lens(pair, focal=factor), simulated(pair))
        (check,) = named(result, "left", "a focal length")[:1]
        assert check.status == "FAIL"
        words = "shorter" if factor > 1 else "longer"
        assert f"% {words}" in check.text
        percent = float(check.text.split("a focal length ")[1].split("%")[0])
        # A tenth of it goes into the pose where the gate cuts: the loss is robust.
        assert percent == pytest.approx(100 * abs(1 / factor - 1), rel=0.1)

    def test_images_undistorted_twice_fail(self, pair: Rig) -> None:
        result = solve(with_lens(pair, distortion=(-0.2, 0.0, 0.0, 0.0)), simulated(pair))
        assert named(result, "left", "radial distortion")[0].status == "FAIL"

    def test_a_shifted_centre_is_worth_a_warning(self, pair: Rig) -> None:
        result = solve(with_lens(pair, cx=20.0), simulated(pair))
        (check,) = named(result, "left", "principal point")
        assert check.status == "WARN"
        (found,) = re.findall(r"off by \((-[0-9.]+), ", check.text)
        assert abs(float(found) + 20) < 1

    def test_what_hangs_on_the_focal_length_is_told(self, pair: Rig) -> None:
        far = solve(pair, simulated(pair, depth_m=(40.0, 80.0)))
        near = solve(pair, simulated(pair))
        words = "focal length wrong by 1 %"
        assert named(near, "left", words)[0].status == "PASS"
        assert named(far, "left", words)[0].status == "WARN"

    def test_a_wall_hides_a_wrong_focal_length_and_that_is_told(self, pair: Rig) -> None:
        """On a wall straight ahead, one percent of focal length is one percent of its distance."""
        T = pair.T_camera_lidar["left"]
        table = simulated(pair).of_camera("left")
        ahead = table.points_lidar_m @ T[:3, :3].T + T[:3, 3]
        ahead *= 20.0 / ahead[:, 2:]
        wall = (ahead - T[:3, 3]) @ T[:3, :3]
        rig = Rig(cameras={"left": pair.cameras["left"]})
        flat = Correspondences.from_arrays(
            camera="left", frame=table.frame, pixels_px=table.pixels_px, points_lidar_m=wall
        )
        result = solve(rig, flat)
        (check,) = named(result, "left", "focal length wrong by 1 %")
        assert check.status == "WARN" and check.value == pytest.approx(20.0, rel=0.02)


class TestGuess:
    @pytest.mark.parametrize("words", readings(np.eye(4)))
    def test_every_mistake_is_recognised_by_what_undoes_it(self, words: str) -> None:
        """The readings of a wrong guess hold the right one, under the mistake's name."""
        truth = make_camera((0.8, 0.3, -0.4), yaw_deg=50).T_camera_lidar
        assert nearest_reading(mistaken(words, truth), truth) == words

    def test_an_inverted_guess_is_named(self, pair: Rig) -> None:
        poses = {name: np.linalg.inv(T) for name, T in pair.T_camera_lidar.items()}
        result = solve(pair.moved_to(poses), simulated(pair))
        assert result.verdict.status == "WARN"
        assert any("it seems to be inverted" in reason for reason in result.verdict.reasons)

    def test_a_near_guess_is_not_questioned(self, pair: Rig) -> None:
        guess = calibgraph.perturb(pair, rotation_deg=10, translation_m=1, seed=1)
        for name, T in pair.T_camera_lidar.items():
            checks = guess_checks(guess.T_camera_lidar[name], T, MatcherFindings())
            assert all(check.status == "PASS" for check in checks)

    def test_swapped_cameras_are_named(self, pair: Rig) -> None:
        """Half a metre apart, from 2 deg and 20 cm; and the same the right way round."""
        right = pair.T_camera_lidar
        swapped = dict(zip(right, reversed(right.values()), strict=True))
        guess = calibgraph.perturb(pair, rotation_deg=2, translation_m=0.2, seed=3).T_camera_lidar
        for name in right:
            assert [check.status for check in swap_check(name, guess, right)] == ["PASS"]
            (check,) = swap_check(name, guess, swapped)
            assert check.status != "PASS" and "are their images swapped" in check.text
        # Lenses of one housing, and results that are off by more than these are apart.
        near = {"left": np.eye(4), "right": np.eye(4)}
        near["right"][0, 3] = 0.02
        for results in (near, dict(zip(near, reversed(near.values()), strict=True))):
            assert [check.status for check in swap_check("left", near, results)] == ["PASS"]
        assert swap_check("left", {"left": guess["left"]}, {"left": right["left"]}) == []

    def test_points_in_millimetres_fail(self, pair: Rig) -> None:
        table = simulated(pair, errors=MatcherErrors())
        huge = Correspondences(**{**vars(table), "points_lidar_m": 1000 * table.points_lidar_m})
        result = solve(pair, huge)
        assert named(result, "left", "are the clouds in millimetres?")[0].status == "FAIL"


def mistaken(words: str, truth: np.ndarray) -> np.ndarray:
    """The guess of someone who makes the mistake of that name."""
    inverse, wrong = np.linalg.inv(truth), truth.copy()
    if words.startswith("inverted (it"):
        return inverse
    if words.startswith("of camera axes"):
        return np.linalg.inv(OPTICAL_FROM_BODY) @ truth
    if words.startswith("inverted, and of"):
        return np.linalg.inv(np.linalg.inv(OPTICAL_FROM_BODY) @ truth)
    if words.startswith("the camera's position"):
        wrong[:3, 3] = inverse[:3, 3]
    if words.startswith("a transposed"):
        wrong[:3, :3] = truth[:3, :3].T
    if words.startswith("a translation in"):
        wrong[:3, 3] *= 1000
    if words.startswith("inverted, with"):
        inverse[:3, 3] *= 1000
        return inverse
    return wrong
