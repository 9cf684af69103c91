from __future__ import annotations

import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml

import calibgraph
from calibgraph import MatcherErrors, Rig, simulate_correspondences
from calibgraph.rounds import match_in_rounds
from calibgraph.trust.guess import likely_intended_guess
from calibgraph.trust.rematch_checks import last_round_checks, rematch_checks
from tests.conftest import SAMPLE, Call


def silent(what: str, done: int, total: int) -> None:
    """Progress that nobody reads."""


class Simulated:
    """A matcher that sees the truth, or what it is told to see, in rounds for near starts."""

    rounds, stage1, tracking_rounds = 1, "rig", (0,)

    def __init__(self, seen: list[Rig]) -> None:
        self.seen = seen

    def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN201
        return simulate_correspondences(self.seen.pop(0), frames=6, matches=100)


class Contrasting(Simulated):
    """One that also says how far image and cloud agree."""

    def __init__(self, seen: list[Rig], contrasts: list[dict[str, float]]) -> None:
        super().__init__(seen)
        self.contrasts = contrasts

    def match(self, dataset, rig, *, round_index, progress):  # noqa: ANN001, ANN201
        table = super().match(dataset, rig, round_index=round_index, progress=progress)
        return replace(table, metadata={"contrast": self.contrasts.pop(0)})


@pytest.fixture
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


def test_a_matcher_that_comes_back_passes(truth: Rig) -> None:
    matched = match_in_rounds(SAMPLE, truth, Simulated([truth, truth]), progress=silent)
    for checks in rematch_checks(matched.rematch).values():
        assert [check.status for check in checks] == ["PASS", "PASS"]


def test_a_matcher_that_ends_elsewhere_fails(truth: Rig) -> None:
    other = calibgraph.perturb(truth, rotation_deg=1, translation_m=0.1, seed=1)
    matched = match_in_rounds(SAMPLE, truth, Simulated([truth, other]), progress=silent)
    for checks in rematch_checks(matched.rematch).values():
        assert checks[0].status == "FAIL" and checks[0].value == pytest.approx(1.0, abs=0.02)


def test_a_camera_is_taken_from_where_image_and_cloud_agree_clearly_better(truth: Rig) -> None:
    """Two cameras stood still 8 cm off; only of one is the other end better."""
    off = calibgraph.perturb(truth, rotation_deg=0.1, translation_m=0.08, seed=1)
    agreed = [
        {"front_left": 16.0, "front_right": 20.0, "left": 18.0},
        {"front_left": 18.0, "front_right": 20.1, "left": 17.0},
    ]

    matched = match_in_rounds(SAMPLE, truth, Contrasting([off, truth], agreed), progress=silent)
    errors = calibgraph.evaluate(matched.solution.solved_rig, truth).cameras
    assert errors["front_left"].translation_error_cm < 1
    for name in ("front_right", "left"):
        assert errors[name].translation_error_cm == pytest.approx(8, abs=1)
    expected = {"front_left": 18.0, "front_right": 20.0, "left": 18.0}
    assert matched.correspondences.metadata["contrast"] == expected
    for checks in rematch_checks(matched.rematch).values():  # two ends are worth a warning
        assert checks[1].status == "WARN" and checks[1].value == pytest.approx(8, abs=1)
    began = calibgraph.evaluate(matched.solution.rig, truth).cameras
    assert began["left"].translation_error_cm < 1e-6  # the guess, of the first rounds
    assert began["front_left"].translation_error_cm > 1  # of the second, displaced from an end


def test_no_round_of_matching_again_begins_when_time_is_over(truth: Rig) -> None:
    matcher = Simulated([truth, truth])
    match = matcher.match

    def slow(*arguments, **named):  # noqa: ANN002, ANN003, ANN202
        time.sleep(0.3)
        return match(*arguments, **named)

    matcher.match = slow  # type: ignore[method-assign]
    matched = match_in_rounds(SAMPLE, truth, matcher, time_limit_s=0.2, progress=silent)
    assert matched.out_of_time and matched.rematch is None and len(matcher.seen) == 1


def test_of_ends_too_far_apart_the_first_is_kept(truth: Rig) -> None:
    """The camera fails; what is better on a flat objective says nothing then."""
    other = calibgraph.perturb(truth, rotation_deg=0.9, translation_m=0.08, seed=1)
    agreed = [dict.fromkeys(truth.cameras, contrast) for contrast in (6.0, 7.5)]

    matched = match_in_rounds(SAMPLE, truth, Contrasting([truth, other], agreed), progress=silent)
    for error in calibgraph.evaluate(matched.solution.solved_rig, truth).cameras.values():
        assert error.rotation_error_deg < 0.1


def test_the_last_round_is_judged_only_if_there_are_others() -> None:
    still = {"front": {"matches": 9, "moved_deg": 0.0, "moved_cm": 0.0}}
    moving = {"front": {"matches": 9, "moved_deg": 0.5, "moved_cm": 5.0}}
    assert last_round_checks([moving], "front") == []
    assert [c.status for c in last_round_checks([still, moving], "front")] == ["FAIL", "WARN"]
    assert [c.status for c in last_round_checks([moving, still], "front")] == ["PASS", "PASS"]


def test_an_inverted_guess_is_recognised_by_the_images(truth: Rig) -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    inverted = {name: np.linalg.inv(T) for name, T in truth.T_camera_lidar.items()}
    meant = likely_intended_guess(data, truth.moved_to(inverted))
    assert meant == "inverted (it is T_lidar_camera)"


def test_images_that_nobody_needed_do_not_cost_the_result(tmp_path: Path, truth: Rig) -> None:
    """A table of nonsense, and images that cannot be read: FAIL, with a word about the images."""
    shutil.copytree(SAMPLE, tmp_path / "data")
    for path in (tmp_path / "data" / "cameras").rglob("*.jpg"):
        path.write_bytes(path.read_bytes()[:1000])
    nonsense = simulate_correspondences(truth, frames=6, errors=MatcherErrors(outlier_share=1.0))
    result = calibgraph.calibrate(tmp_path / "data", matcher=nonsense)
    assert result.verdict.status == "FAIL"
    assert any("the images could not be asked" in reason for reason in result.verdict.reasons)


@pytest.mark.slow
def test_a_failure_marks_every_file_and_exits_1(call: Call, tmp_path: Path, truth: Rig) -> None:
    """Random correspondences: FAIL in the result, in the table, in the pictures, on the page."""
    nonsense = simulate_correspondences(truth, frames=6, errors=MatcherErrors(outlier_share=1.0))
    nonsense.save(tmp_path / "table.parquet")
    out = tmp_path / "out"
    code, _, text = call("calibrate", SAMPLE, "--matcher", tmp_path / "table.parquet", "--out", out)
    assert code == 1 and text.startswith("FAIL")
    assert yaml.safe_load((out / "calibration.yaml").read_text())["verdict"]["status"] == "FAIL"
    metadata = pq.read_schema(out / "correspondences.parquet").metadata
    assert any(b'"FAIL"' in value for value in metadata.values())
    assert "FAIL" in (out / "report.html").read_text().split("</title>")[0]
    calibgraph.load_calibration(out)


def test_the_error_bar_of_cameras_and_pairs_is_told(call: Call, tmp_path: Path, pair: Rig) -> None:
    pair.save(tmp_path / "rig.yaml")
    simulate_correspondences(pair, frames=8, matches=100).save(tmp_path / "table.parquet")
    command = (
        "solve", tmp_path / "rig.yaml", tmp_path / "table.parquet", "--out", tmp_path / "out",
        "--bootstrap", 5,
    )  # fmt: skip
    code, _, text = call(*command)
    assert code == 0
    for words in ("left->right", "left (bootstrap)", "weakest direction", "roll z"):
        assert words in text
    code, stdout, _ = call(*command, "--json")
    summary = yaml.safe_load(stdout)
    assert len(summary["pairs"]["left->right"]["translation_sigma_cm"]) == 3
    assert summary["cameras"]["left"]["weaknesses"]
    content = yaml.safe_load((tmp_path / "out" / "calibration.yaml").read_text())
    assert "xi = (rotation [rad], translation [m])" in content["covariance_of"]
    assert "in the axes of B" in content["pair_covariance_of"]
    assert content["config"]["bootstrap"] == 5
