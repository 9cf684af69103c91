"""Rounds that go on from where the images say that the cameras are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import gtsam
import numpy as np
import pytest

import calibgraph
from calibgraph import Config
from calibgraph.arrays import Array
from calibgraph.elsewhere import go_on_elsewhere
from calibgraph.matching.run import MatchingRun
from calibgraph.model.geometry import pose_difference
from calibgraph.model.verdict import TOLERANCE, WENT_ON, Check
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.pose_posterior import PosePosterior
from calibgraph.trust.probability import STRUCTURE, judge
from calibgraph.trust.rematch_checks import going_on_checks
from calibgraph.trust.run_evidence import RunEvidence
from tests.conftest import SAMPLE

ONE = "front_left"


@pytest.fixture(scope="module")
def run() -> MatchingRun:
    """One camera of the sample, near its place."""
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    data = calibgraph.load_dataset(SAMPLE, calibgraph.Rig(cameras={ONE: truth.cameras[ONE]}))
    return match_in_rounds(data.select("0:4"), None, "structure", Config(), progress=no_progress)


def displaced(run: MatchingRun, twist: Array, z_score: float) -> MatchingRun:
    """The run as if its rounds had ended elsewhere, with such a z-score."""
    T = gtsam.Pose3.Expmap(twist).matrix() @ run.solution.T_camera_lidar[ONE]
    table = run.correspondences
    points = table.points_lidar_m @ T[:3, :3].T + T[:3, 3]
    wrong = replace(table, pixels_px=run.guess.cameras[ONE].lens.project(points)[0])
    findings = replace(table.findings, z_score={ONE: z_score})
    ended = solve_joint(run.guess.moved_to({ONE: T}), wrong, Config())
    return replace(run, correspondences=wrong.with_findings(findings), solution=ended)


def told(twist: Array, share: float) -> PosePosterior:
    """A posterior whose poses elsewhere scatter about a twist, which is the densest."""
    scatter = np.vstack([np.zeros(6), 1e-4 * np.random.default_rng(0).standard_normal((99, 6))])
    return PosePosterior(scatter, twist + scatter, share)


def follow(run: MatchingRun, *posteriors: PosePosterior) -> tuple[RunEvidence, RunEvidence]:
    """The evidence before and after, with posteriors that are given one after the other."""
    evidence = RunEvidence(run, {})
    given = [{ONE: each} for each in posteriors]
    with patch.object(RunEvidence, "_measure_posteriors", side_effect=given):
        return evidence, go_on_elsewhere(evidence)


def test_rounds_go_on_from_where_the_images_say(run: MatchingRun) -> None:
    away = np.r_[0.0, np.radians(0.6), 0.0, 0.0, 0.0, 0.1]
    wrong = displaced(run, away, z_score=1.0)
    right = run.solution.T_camera_lidar[ONE]
    assert pose_difference(wrong.solution.T_camera_lidar[ONE], right)[0] > 0.5
    _, after = follow(wrong, told(-away, share=0.9), told(np.zeros(6), share=0.1))
    degrees, centimetres = pose_difference(after.run.solution.T_camera_lidar[ONE], right)
    assert degrees < 0.1 and centimetres < 2.0
    assert after.run.correspondences.findings.z_score[ONE] > 5.0
    assert after.run.went_on[ONE][0] == pytest.approx(0.6, abs=0.1)
    assert wrong.rematch is not None and after.run.rematch is None  # it was of the first end
    (check,) = going_on_checks(after)[ONE]
    assert "ended 0.6 deg" in check.text


def test_an_end_that_agrees_less_is_not_taken(run: MatchingRun) -> None:
    away = np.r_[0.0, np.radians(0.6), 0.0, 0.0, 0.0, 0.1]
    wrong = displaced(run, away, z_score=1e3)
    before, after = follow(wrong, told(-away, share=0.9))
    assert after is before


def test_the_time_limit_holds(run: MatchingRun) -> None:
    away = np.r_[0.0, np.radians(0.6), 0.0, 0.0, 0.0, 0.1]
    wrong = replace(displaced(run, away, z_score=1.0), is_late=lambda: True)
    before, after = follow(wrong, told(-away, share=0.9))
    assert after is before


def test_a_pose_that_the_posterior_chose_is_no_pass() -> None:
    check = Check("rounds that went on", "WARN", "as it is", 0.6, kind=WENT_ON)
    without, judged = (judge(each, 0.0, TOLERANCE, STRUCTURE) for each in ((), (check,)))
    assert without.status == "PASS"
    assert judged.status == "WARN" and judged.cannot_tell
    assert judged.error_probability == without.error_probability


@pytest.mark.realdata
def test_grass_leads_the_rounds_away_and_the_images_back(realdata: Path) -> None:
    """KITTI 10: without it the cameras end 0.6 degrees and 25 cm off."""
    folder = realdata / "kitti_odometry" / "sequences" / "10"
    reference = calibgraph.load_dataset(folder).rig
    start = calibgraph.perturb(reference, rotation_deg=2, translation_m=0.2, seed=0, uniform=True)
    result = calibgraph.calibrate(folder, start)
    for name, errors in calibgraph.evaluate(result.rig, reference).cameras.items():
        assert errors.rotation_error_deg < 0.3, name
        assert errors.translation_error_cm < 18, name
    assert result.verdict.status == "WARN"
