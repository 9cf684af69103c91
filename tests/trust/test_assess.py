"""All checks of a solution together."""

from __future__ import annotations

import numpy as np

import calibgraph
from calibgraph import MatcherErrors, Rig, simulate_correspondences, solve
from tests.conftest import SAMPLE
from tests.trust.conftest import named, simulated


def test_good_data_pass_every_check(pair: Rig) -> None:
    result = solve(pair, simulated(pair))
    assert result.verdict.status == "PASS", result.verdict.reasons
    for words in ("competing solution", "distance from the guess"):
        assert named(result, "left", words), words


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
