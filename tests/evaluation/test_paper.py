"""The benchmark and the search for settings."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import Config, CorrespondenceError, load_config, preset
from calibgraph.evaluation.baselines import TRF_TOLERANCE, oracle_weights, paper_solve
from calibgraph.evaluation.methods import HEADLINE, ORACLE, STAGE1, TRF_TERMS, WAYS, Bench
from calibgraph.evaluation.output import markdown, to_mapping, write_report
from calibgraph.evaluation.paper import bench_paper, interval
from calibgraph.evaluation.published import PAIR, published
from calibgraph.evaluation.sources import Recorded, Sample, Simulated, source_of
from calibgraph.evaluation.tune import Candidates, tune
from calibgraph.io.kitti import load_kitti_rig
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.simulation.scenarios import scenario_of
from calibgraph.solver.camera_block import camera_blocks
from calibgraph.solver.joint import solve_joint
from tests.conftest import SAMPLE, Call

KITTI = preset("kitti")


@dataclass(frozen=True)
class Thinned(Simulated):
    """A scenario with only so many matches per draw in its first camera."""

    kept: int = 5

    def draw(self, frames: int, seed: int) -> Sample:
        sample = super().draw(frames, seed)
        first = sample.table.camera_index == 0
        few = ~first | (np.cumsum(first) <= self.kept)
        return replace(sample, table=sample.table.select(few))


def test_the_papers_solver_and_ours_reach_the_same_poses() -> None:
    left = [ours for seed in range(5) for ours in cost_left_by_trf(seed)]
    # TRF stops when a step lowers the cost by less than 1e-6 of it, or is as small. What is left to
    # go is at most ten times that, if each step takes it to 0.9 of it or less. A match at the edge
    # of the gate, in for the one and out for the other, may move an optimum farther.
    assert sum(share < 10 * TRF_TOLERANCE for share in left) >= 7
    assert max(left) < 1000 * TRF_TOLERANCE


def cost_left_by_trf(seed: int) -> list[float]:
    """Per camera, by what share of the cost the paper's solver ends above ours."""
    sample = source_of("kitti").draw(3, seed=seed)
    theirs = Bench.of(sample, KITTI, seed=1).of_paper("full")
    ours = solve_joint(sample.rig, sample.table, KITTI, "full", pairwise=sample.stage1(KITTI))
    left = []
    for name, matches in ours.inliers.blocks.items():
        pose, other = to_T_lidar_camera(ours.T_camera_lidar[name]), to_T_lidar_camera(theirs[name])
        away = pose.localCoordinates(other)
        hessian = matches.with_scale(ours.scales[name]).sums(pose).hessian
        left.append(float(away @ hessian @ away) / ours.optimum.cost)
    return left


def test_priors_alone_are_least_at_stage_1() -> None:
    bench = Bench.of(source_of("walkley").draw(3, seed=0), preset("walkley"), seed=0)
    found, hat = bench.of_paper("priors"), bench.aggregated("median")
    for name, T in hat.items():
        np.testing.assert_allclose(found[name], T, atol=1e-9)


def test_the_papers_solver_refuses_settings_that_are_not_the_papers() -> None:
    sample = source_of("kitti").draw(1, seed=0)
    with pytest.raises(ValueError, match="needs a Cauchy loss"):
        paper_solve(sample.rig, sample.table, sample.rig.T_camera_lidar, Config(), "full")


def test_oracle_weights_are_low_for_frames_that_err() -> None:
    rig = scenario_of("kitti").rig
    table = source_of("kitti").draw(4, seed=2).table.of_camera("image_2")
    wrong = table.frame == 1
    spoilt = replace(table, pixels_px=table.pixels_px + np.where(wrong, 5.0, 0.0)[:, None])
    matches = camera_blocks(rig, spoilt, KITTI)["image_2"]
    weights = oracle_weights(matches, rig.cameras["image_2"].T_camera_lidar)
    assert weights.max() == 1.0
    # 1000 matches that are all 5 px off: their pose errs by 1000 * 50 / 6 px^2 of a single match;
    # the others of this scenario by some px at most.
    assert weights[matches.frame == 1].max() < 0.01


def test_bench_writes_every_row_and_metric(tmp_path: Path, call: Call) -> None:
    code, _, text = call("bench", "paper", "kitti", "--frames", 5, "--draws", 2, "--out", tmp_path)
    assert code == 0, text
    content = json.loads((tmp_path / "paper.json").read_text())
    (block,) = content["blocks"]
    assert (block["frames"], block["draws"], block["reference"]) == (5, 2, "truth")
    assert list(block["rows"]) == list(WAYS)
    for row in block["rows"].values():
        assert row["failed"] == 0
        assert list(row["numbers"]) == ["image_2", "image_3", "image_2->image_3"]
        for camera in ("image_2", "image_3"):
            numbers = row["numbers"][camera]
            assert len(numbers) == 10  # E_t, E_R, six axes, reprojection, better by
            assert all(np.isfinite(value["median"]) for value in numbers.values())
    stage1 = block["rows"][STAGE1]["numbers"]["image_2"]
    assert stage1["reprojection_improvement_px"]["median"] == 0.0
    tables = (tmp_path / "paper.md").read_text()
    assert all(name in tables for name in WAYS)
    assert cv2.imread(str(tmp_path / "paper.png")) is not None


def test_the_same_seed_gives_the_same_numbers_in_any_number_of_processes() -> None:
    source, options = source_of("kitti"), {"frames": [1], "draws": 2, "config": KITTI}
    made = [to_mapping(bench_paper(source, trf=False, jobs=jobs, **options)) for jobs in (1, 2)]
    assert made[0].pop("seconds") != made[1].pop("seconds")
    assert made[0] == made[1]


def test_intervals_are_medians_and_quantiles() -> None:
    found = interval([5.0, 1.0, 3.0, 2.0, 4.0, np.nan])
    # Linear between order statistics: 5 % of the way along 1 .. 5 is 1.2.
    assert (found.low, found.median, found.high) == pytest.approx((1.2, 3.0, 4.8))
    assert np.isnan(interval([np.nan]).median)


def test_rows_that_find_nothing_say_so() -> None:
    report = bench_paper(Thinned("kitti"), frames=[2], draws=1, config=KITTI)
    rows = report.blocks[0].rows
    assert all(rows[name].failed == 1 for name in (STAGE1, HEADLINE, *TRF_TERMS))
    assert "| failed |" in markdown(report)


def test_a_recording_that_is_not_matched_fails_in_every_row(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, call: Call
) -> None:
    def give_up(*arguments: object, **options: object) -> None:
        raise CorrespondenceError("nothing", camera="left")

    monkeypatch.setattr("calibgraph.evaluation.sources.match_in_rounds", give_up)
    report = bench_paper(source_of(str(SAMPLE)), frames=[2], draws=1, config=KITTI)
    assert report.published_as == ""
    assert all(row.failed == 1 for row in report.blocks[0].rows.values())
    assert len(write_report(report, tmp_path)) == 3
    for command in (("bench", "paper"), ("tune",)):
        options = "--frames", 2, "--draws", 1, "--out", tmp_path / "new.yaml"
        code, _, text = call(*command, SAMPLE, *options)
        assert code == 2 and "calibgraph calibrate says why" in text
        assert not (tmp_path / "new.yaml").exists()


def test_the_papers_numbers_stand_beside_its_rows() -> None:
    full = list(TRF_TERMS)[-1]
    assert published("kitti", full, 100, 0)["translation_error_cm"] == 0.89
    assert published("walkley", full, 100, 1)["translation_error_cm"] == 3.14
    assert published("kitti", full, 10, PAIR)["rotation_error_deg"] == 0.033
    assert published("kitti", full, 10, 1)["reprojection_px"] == 0.41
    assert published("surround", full, 10, 0) == published("kitti", HEADLINE, 10, 0) == {}


def test_only_simulations_have_a_bound() -> None:
    sample = source_of("kitti").draw(2, seed=0)
    real = replace(sample, simulated=False, references={"reference": sample.references["truth"]})

    @dataclass(frozen=True)
    class Real(Simulated):
        def draw(self, frames: int, seed: int) -> Sample:
            return real

    report = bench_paper(Real("kitti"), frames=[2], draws=1, config=KITTI, trf=False)
    assert list(report.blocks[0].rows) == [n for n in WAYS if n != ORACLE and n not in TRF_TERMS]


def test_tune_picks_the_better_settings_and_tests_them_on_other_draws(tmp_path: Path) -> None:
    # A third of Walkley's matches are outliers: a loss and a gate of 1000 px let them in.
    sets = Candidates((1.0,), (5.0,), (1000.0, 4.0), (1000.0,))
    tuned = tune(source_of("walkley"), base=preset("walkley"), frames=3, draws=2, candidates=sets)
    assert [row.config.loss_scale_px for row in tuned.tried] == [4.0, 1000.0]
    assert tuned.tried[0].tuning < tuned.tried[1].tuning
    assert tuned.best.test not in (None, tuned.best.tuning)
    tuned.save(tmp_path / "found.yaml")
    assert load_config(tmp_path / "found.yaml") == tuned.best.config


def test_tuning_and_test_frames_are_kept_apart() -> None:
    one, two = source_of("kitti").halves(0)
    assert not np.array_equal(one.draw(1, 0).table.pixels_px, two.draw(1, 0).table.pixels_px)
    halves = source_of(str(SAMPLE)).halves(0)
    chosen = [set(half.positions or ()) for half in halves if isinstance(half, Recorded)]
    assert chosen[0] | chosen[1] == set(range(6))
    assert not chosen[0] & chosen[1]


def test_candidates_are_drawn_once_each() -> None:
    sets = Candidates((0.0, 1.0), (0.0, 5.0), (2.0,), (3.0,))
    found = sets.sampled(KITTI, 50, seed=0)
    assert len(found) == 4
    assert len({(c.prior_weight, c.relative_prior_weight) for c in found}) == 4


def test_both_readings_of_kittis_ground_truth(tmp_path: Path) -> None:
    P = "700 0 600 350 0 700 180 7 0 0 1 0.01"
    (tmp_path / "calib.txt").write_text(f"P2: {P}\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "image_2").mkdir()
    cv2.imwrite(str(tmp_path / "image_2" / "0.png"), np.zeros((370, 1226), np.uint8))
    full = load_kitti_rig(tmp_path).T_camera_lidar["image_2"][:3, 3]
    along_x = load_kitti_rig(tmp_path, shift_along_x_only=True).T_camera_lidar["image_2"][:3, 3]
    # K^-1 P[:,3] by hand: z = 0.01, x = (350 - 600 z) / 700, y = (7 - 180 z) / 700.
    np.testing.assert_allclose(full, [344 / 700, 5.2 / 700, 0.01])
    np.testing.assert_allclose(along_x, [0.5, 0.0, 0.0])
    assert list(Recorded((tmp_path,)).references) == ["K^-1 P[:,3] (right)", "P[0,3]/fx only"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("bench", "paper", "nowhere"), "'nowhere' is no scenario (kitti, walkley"),
        (("bench", "paper", "kitti", "--frames", "ten"), "--frames ten: give whole numbers"),
        (("bench", "paper", "kitti", "--preset", "auto"), "--preset auto: give the paper's"),
        (("bench", "paper", "kitti", "--preset", "x"), "unknown preset 'x'"),
        (("tune", "kitti", "--lambda", "a"), "--lambda a: give numbers"),
        (("tune", "kitti", "--tau", "-1"), "gate_px"),
        (("tune", "kitti", "--frames", "10001"), "10001 frames: at most 10000"),
        (("bench", "paper", "kitti", "--frames", "10001"), "10001 frames: at most 10000"),
    ],
)
def test_wrong_arguments_are_one_line(
    arguments: tuple[str, ...], said: str, tmp_path: Path, call: Call
) -> None:
    code, _, text = call(*arguments, "--out", tmp_path / "out.yaml")
    assert code == 2
    assert said in text
    assert text.count("\n") == 1
    assert not (tmp_path / "out.yaml").exists()
