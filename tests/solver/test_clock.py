"""Clocks that are estimated with the extrinsics: found, not overrated, and kept where unseen."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from calibgraph import Config, Rig, load_calibration, load_correspondences, solve
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.error_sources import MOTION
from calibgraph.model.geometry import twist_between
from calibgraph.model.verdict import TOLERANCE
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.lens_checks import intrinsics_checks
from factors import Clock, displace
from tests.draws.clocks import draw_twists, put_clock_error
from tests.draws.lenses import put_lens_error, with_fields
from tests.solver.test_lens import FIVE_SIGMAS, simulated, squared_errors

STRAIGHT = np.array([0.0, 0.0, 0.0, 10.0, 0.0, 0.0])


def late(
    offset_s: float, readout_s: float, seed: int = 0, twists: np.ndarray | None = None
) -> tuple[Rig, Correspondences]:
    """Two cameras like KITTI's whose images are late, and matches of 30 frames."""
    rig, table = simulated(seed, frames=30, matches=100)
    twists = draw_twists(30, np.random.default_rng(seed)) if twists is None else twists
    return rig, put_clock_error(table, rig, twists, Clock(offset_s, readout_s))


TURN, AHEAD, ASIDE = np.eye(6)[2:5] * [[0.1], [10.0], [10.0]]


@pytest.mark.parametrize(("number", "twist"), [(0, TURN), (1, AHEAD), (2, ASIDE)])
def test_what_an_unknown_motion_does_to_a_sweep_is_in_the_bar(
    number: int, twist: np.ndarray
) -> None:
    """Points of one camera are 20 to 40 ms late, of the other 10 ms early; both move as stated."""
    truth, table = simulated(0, frames=10, matches=100)
    late_s = np.where(table.camera_index == 0, 0.03 + 2e-5 * (table.pixels_px[:, 0] - 600), -0.01)
    swept = displace(table.points_lidar_m, twist, -late_s)
    still = Evidence(solve_joint(truth, replace(table, late_s=np.zeros(len(table)))), truth)
    found = Evidence(solve_joint(truth, replace(table, points_lidar_m=swept, late_s=late_s)), truth)
    assert not still.solution.travel.any()
    assert [*intrinsics_checks(still)] and not [
        *intrinsics_checks(found)
    ]  # a sweep looks like a lens
    moved = np.concatenate([
        twist_between(found.solution.T_camera_lidar[name], still.solution.T_camera_lidar[name])
        for name in truth.cameras
    ])  # fmt: skip
    expected = found.solution.travel[:, number]
    np.testing.assert_allclose(-moved, expected, atol=0.05 * np.abs(expected).max())
    joint, known = found.joint_covariance, found.solution.covariance
    np.testing.assert_allclose(joint - known, found.solution.travel @ found.solution.travel.T)
    name = next(iter(truth.cameras))
    assert found.probability_beyond(name) > 0.5 > still.probability_beyond(name)
    sources = found.error_sources[name]
    assert sources.translation[MOTION] > 0.9
    assert "--motion for bags" in sources.action(TOLERANCE)
    pair = found.pair_covariances()["->".join(truth.cameras)]
    assert np.sqrt(pair[3, 3]) > 0.2  # 10 m/s in 40 ms


@pytest.mark.parametrize(
    ("offset_s", "readout_s", "part"),
    [(0.1, 0.0, "offset"), (-0.02, 0.0, "offset"), (0.02, 0.03, "clock")],
)
def test_late_images_are_found(offset_s: float, readout_s: float, part: str) -> None:
    truth, table = late(offset_s, readout_s)
    found = solve_joint(truth, table, Config(estimate=part))
    right = {"offset": offset_s, "readout": readout_s}
    for name, parameters in found.lens.items():
        for one in parameters:
            assert one.is_determined
            assert abs(one.value - right[one.name]) < FIVE_SIGMAS * one.sigma
            assert one.sigma < 1e-3
        assert found.solved_rig.cameras[name].time_offset_s == pytest.approx(
            parameters[0].value, abs=1e-12
        )
    assert max(squared_errors(found, truth)) < chi2.isf(1e-6, 6)


@pytest.mark.parametrize(
    ("sigma_s", "status"), [(0.004, "PASS"), (0.0025, "WARN"), (0.0005, "FAIL")]
)
def test_an_offset_beyond_what_the_rig_allows_is_no_pass(sigma_s: float, status: str) -> None:
    """50 ms late: 12.5, 20 and 100 prior sigmas, with limits at 13.5 and 56.1."""
    truth, table = late(0.05, 0.0)
    rig = with_fields(truth, time_offset_sigma_s=sigma_s)
    result = solve(rig, table, Config(estimate="offset", common_deg=0.0))
    for name, verdict in result.camera_verdicts.items():
        (check,) = [one for one in verdict.checks if one.kind == "time_prior"]
        assert check.status == verdict.status == status
        assert check.value == pytest.approx(0.05 / sigma_s, rel=0.05)
        if status != "PASS":
            (one,) = result.lens[name]
            assert check.text.startswith("offset: distance from the rig")
            assert one.change in check.text and "before 0" in one.change
    if status != "PASS":
        (reason,) = result.summary.reasons
        assert reason.cause == "time" and "correct the named time in the rig" in reason.action


def test_a_known_clock_is_as_good_as_none() -> None:
    """Points at the times of the pixels, and points of late images with the times in the rig."""
    truth, table = late(0.04, 0.02)
    _, same = late(0.0, 0.0)
    known = with_fields(truth, time_offset_s=0.04, readout_s=0.02)
    expected, found = (solve_joint(rig, t) for rig, t in ((truth, same), (known, table)))
    for name, T in expected.T_camera_lidar.items():
        twist = twist_between(found.T_camera_lidar[name], T)
        assert np.abs(twist).max() < 1e-6  # exact but for the digits of the displacement


def test_a_stated_error_of_the_clock_is_one_of_the_pose() -> None:
    """10 ms at 10 m/s, which is 10 cm along the drive; at an unknown motion it is not."""
    truth, table = late(0.0, 0.0, twists=np.tile(STRAIGHT, (30, 1)))
    doubted, truth = (with_fields(truth, time_offset_sigma_s=each) for each in (0.01, 1e-6))
    still = replace(table, twist_per_s=None)
    for of, matches, added_m in (
        ("mount", table, 0.1), ("alignment", table, 0.1), ("alignment", still, 0.0)
    ):  # fmt: skip
        known, unknown = (solve_joint(rig, matches, Config(of=of)) for rig in (truth, doubted))
        added = np.diag(unknown.covariance - known.covariance).reshape(-1, 2, 3).sum(axis=2)
        np.testing.assert_allclose(np.sqrt(np.abs(added[:, 1])), added_m, rtol=0.02, atol=1e-6)
        for name, T in known.T_camera_lidar.items():
            assert np.abs(twist_between(unknown.T_camera_lidar[name], T)).max() < 1e-6


def test_a_saved_result_is_solved_again(tmp_path: Path) -> None:
    truth, table = late(0.03, 0.0)
    result = solve(truth, table, Config(estimate=("offset",)))
    assert result.not_included.startswith("intrinsics beyond what the rig states, ")
    result.save(tmp_path)
    saved = load_calibration(tmp_path)
    for name, camera in result.rig.cameras.items():
        assert saved.rig.cameras[name].time_offset_s == camera.time_offset_s
    again = solve(saved.rig, load_correspondences(tmp_path / "correspondences.parquet"))
    for camera, T in result.T_camera_lidar.items():
        twist = twist_between(again.T_camera_lidar[camera], T)
        sigmas = np.sqrt(np.diag(result.covariance[camera]))
        assert np.abs(twist / sigmas).max() < 1.0  # its offset is now exact


@pytest.mark.parametrize("twists", [np.zeros((30, 6)), np.tile(STRAIGHT, (30, 1))])
def test_at_rest_or_straight_ahead_the_offset_stays_at_its_prior(twists: np.ndarray) -> None:
    """Straight ahead at constant speed it is a translation ahead, which is then as uncertain."""
    truth, table = late(0.02, 0.0, twists=twists)
    found = solve_joint(truth, table, Config(estimate=("offset",)))
    for parameters in found.lens.values():
        (one,) = parameters
        assert not one.is_determined
        assert abs(one.value - one.prior) < 0.1 * one.prior_sigma
        assert "not determined by these data; record turns" in one.describe()
        if twists.any():
            assert (one.direction, round(one.correlation, 1)) == ("z", 1.0)
    if twists.any():
        ahead_m = found.covariance[5, 5] ** 0.5
        assert ahead_m == pytest.approx(10.0 * one.sigma, rel=0.05)


def test_lens_and_clock_are_told_apart() -> None:
    truth, table = late(0.05, 0.0)
    found = solve_joint(put_lens_error(truth, "focal", 0.01), table, Config(estimate="lens,offset"))
    for parameters in found.lens.values():
        by_name = {one.name: one for one in parameters}
        for name, right in (("focal", 718.856), ("offset", 0.05)):
            one = by_name[name]
            assert one.is_determined
            assert abs(one.value - right) < FIVE_SIGMAS * one.sigma


def test_a_lidar_that_turns_about_its_way_is_told() -> None:
    rig, table = late(0.0, 0.0)
    swapped = replace(table, twist_per_s=table.twist_per_s[:, [2, 1, 0, 3, 4, 5]])
    (text,) = solve(rig, swapped).warnings
    assert "turns about its direction of travel" in text
