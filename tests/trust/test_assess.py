"""All checks of a solution together."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import calibgraph
from calibgraph import Config, MatcherErrors, Rig, simulate_correspondences, solve
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.assess import SOLUTION_CHECKS, assess
from calibgraph.trust.evidence import Evidence
from tests.conftest import SAMPLE
from tests.trust.conftest import named, simulated


def test_good_data_pass_every_check(pair: Rig) -> None:
    result = solve(pair, simulated(pair))
    assert result.verdict.status == "PASS", result.verdict.reasons
    for words in ("even and odd", "competing solution", "distance from the guess"):
        assert named(result, "left", words), words


def test_checks_are_reported_in_the_order_of_the_list(pair: Rig) -> None:
    solution = solve_joint(pair, simulated(pair))
    evidence = Evidence(solution, guess=pair)
    one_by_one = [check(evidence).get("right", ()) for check in SOLUTION_CHECKS]
    assert assess(evidence)["right"] == [check for each in one_by_one for check in each]


def test_checks_and_error_bars_are_written_and_read_again(pair: Rig, tmp_path: Path) -> None:
    result = solve(pair, simulated(pair), Config(bootstrap=5))
    result.save(tmp_path)
    loaded = calibgraph.load_calibration(tmp_path)
    assert loaded.camera_verdicts == result.camera_verdicts
    assert loaded.weaknesses == result.weaknesses and loaded.prior_share == result.prior_share
    for name, covariance in result.bootstrap.items():
        np.testing.assert_allclose(loaded.bootstrap[name], covariance)
    for name, covariance in result.pair_covariance.items():
        np.testing.assert_allclose(loaded.pair_covariance[name], covariance)


def test_an_inverted_guess_is_named_also_when_the_time_is_over() -> None:
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    one = Rig(cameras={"front_left": truth.cameras["front_left"]})
    inverted = one.moved_to({"front_left": np.linalg.inv(one.T_camera_lidar["front_left"])})
    nonsense = simulate_correspondences(one, frames=6, errors=MatcherErrors(outlier_share=1.0))
    data = calibgraph.load_dataset(SAMPLE, inverted, frames="0:2")
    result = calibgraph.calibrate(data, matcher=nonsense, time_limit_s=1e-3)
    (check,) = named(result, "front_left", "convention of the guess")
    assert check.status == "FAIL" and "inverted (it is T_lidar_camera)" in check.text
    assert named(result, "front_left", "there was no time")
