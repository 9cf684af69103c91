"""Rounds of matching and what follows: held cameras, ties by images, poses elsewhere, clocks."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import gtsam
import numpy as np
import pytest

import calibgraph
from calibgraph import (
    Config,
    CorrespondenceError,
    Correspondences,
    Dataset,
    Rig,
    calibrate,
    dataset_from_arrays,
    evaluate,
    load_dataset,
    load_rig,
    perturb,
    rounds,
    simulate_correspondences,
)
from calibgraph.arrays import Array
from calibgraph.io.dataset import keep_frames
from calibgraph.matching.run import MatchingRun
from calibgraph.matching.structure import StructureMatcher
from calibgraph.model.config import Terms
from calibgraph.model.geometry import invert, pose_difference, relative_transform
from calibgraph.model.verdict import TOLERANCE, WENT_ON, Check
from calibgraph.progress import Progress, no_progress
from calibgraph.rounds import (
    follow_neighbours,
    go_on_elsewhere,
    match_in_rounds,
    refine_with_camera_pairs,
)
from calibgraph.solver.joint import solve_joint, solve_without_failing
from calibgraph.trust import evidence
from calibgraph.trust.matcher_checks import compare_ends, going_on_checks
from calibgraph.trust.pose_posterior import PosePosterior
from calibgraph.trust.probability import STRUCTURE, judge
from factors import Clock, displace
from tests.conftest import SAMPLE, require_near, require_poses
from tests.draws.clocks import draw_twists
from tests.draws.lenses import put_lens_error
from tests.matching.structure.data import with_noise_images


@pytest.fixture(scope="module")
def data(truth: Rig) -> Dataset:
    """Its features are found once."""
    return keep_frames(calibgraph.load_dataset(SAMPLE, truth))


@pytest.mark.usefixtures("no_image_checks")
def test_a_camera_that_nothing_determines_fails_and_the_others_are_calibrated(
    truth: Rig, tmp_path: Path
) -> None:
    """The correspondences have none of the camera, and its images show noise."""
    guess = perturb(truth, rotation_deg=2, translation_m=0.2, seed=1)
    data = with_noise_images(calibgraph.load_dataset(SAMPLE, guess), "left", tmp_path)
    table = simulate_correspondences(truth, frames=6)
    others = table.select(table.camera_index != table.cameras.index("left"))
    result = calibgraph.calibrate(data, guess, others)
    assert result.camera_verdicts["left"].status == "FAIL"
    reasons = " ".join(result.camera_verdicts["left"].reasons)
    assert "too few" in reasons and "it is left at its guess" in reasons
    assert result.sigmas("left") is None
    np.testing.assert_allclose(
        result.T_camera_lidar["left"], guess.T_camera_lidar["left"], atol=1e-6
    )
    errors = calibgraph.evaluate(result.rig, truth).cameras
    for name in ("front_left", "front_right"):
        assert errors[name].rotation_error_deg < 0.1, name
        assert errors[name].translation_error_cm < 2, name
        assert result.sigmas(name) is not None
    result.save(tmp_path / "out")
    assert calibgraph.load_calibration(tmp_path / "out").sigmas("left") is None


def test_a_camera_whose_matches_do_not_agree_is_held_and_the_others_are_solved(truth: Rig) -> None:
    """Enough of them to begin with, and too few within the gate: it fails, not the whole rig."""
    table = simulate_correspondences(truth, frames=3, matches=100)
    own = np.flatnonzero(table.camera_index == table.cameras.index("left"))
    pixels = table.pixels_px.copy()
    pixels[own[3:7]] += [[200, 0], [0, 150], [-180, 20], [30, -160]]
    other = np.flatnonzero(table.camera_index != table.cameras.index("left"))
    table = replace(table, pixels_px=pixels).select(np.sort(np.r_[own[:7], other]))
    with pytest.raises(CorrespondenceError, match="within the gate"):
        solve_joint(truth, table, Config())
    solution = solve_without_failing(truth, table, Config())
    assert solution.held == solution.config.excluded_cameras == ("left",)
    for name in ("front_left", "front_right"):
        T = solution.T_camera_lidar[name]
        assert pose_difference(T, truth.cameras[name].T_camera_lidar)[0] < 0.1


def test_a_lone_camera_without_enough_matches_was_perhaps_not_found(
    truth: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then that is the reason, and not the gate."""
    monkeypatch.setattr(rounds, "likely_intended_guess", lambda *_: None)
    rig = calibgraph.Rig(cameras={"left": truth.cameras["left"]})
    data = calibgraph.load_dataset(SAMPLE, rig).select("0")
    few = simulate_correspondences(rig, frames=1, matches=5)
    for missed, reason in (({"left": 7.0}, "the search has not found this camera"), ({}, "")):
        table = few.with_metadata({**few.metadata, "missed": missed})
        with pytest.raises(CorrespondenceError, match=f"correspondences.*{reason}") as error:
            calibgraph.calibrate(data, rig, table)
        assert bool(missed) == ("not found" in str(error.value))


ONE = "front_left"
AWAY = np.r_[0.0, np.radians(0.6), 0.0, 0.0, 0.0, 0.1]


@pytest.fixture(scope="module")
def run(truth: Rig) -> MatchingRun:
    """One camera of the sample, near its place."""
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


def follow(run: MatchingRun, *posteriors: PosePosterior) -> MatchingRun:
    """The run afterwards, with posteriors that are given one after the other."""
    given = [{ONE: each} for each in posteriors]
    with patch.object(evidence, "measure_posteriors", side_effect=given):
        return go_on_elsewhere(run)[0]


def test_rounds_go_on_from_where_the_images_say(run: MatchingRun) -> None:
    wrong = displaced(run, AWAY, z_score=1.0)
    right = run.solution.T_camera_lidar[ONE]
    assert pose_difference(wrong.solution.T_camera_lidar[ONE], right)[0] > 0.5
    after = follow(wrong, told(-AWAY, share=0.9), told(np.zeros(6), share=0.1))
    degrees, centimetres = pose_difference(after.solution.T_camera_lidar[ONE], right)
    assert degrees < 0.1 and centimetres < 2.0
    assert after.correspondences.findings.z_score[ONE] > 5.0
    assert after.went_on[ONE][0] == pytest.approx(0.6, abs=0.1)
    assert wrong.rematch and not after.rematch  # it was of the first end
    check = dict(going_on_checks(after))[ONE]
    assert "ended 0.6 deg" in check.text


def test_of_several_modes_the_end_that_agrees_best_is_taken(run: MatchingRun) -> None:
    """The densest is farther away; the second is right."""
    wrong, right = displaced(run, AWAY, z_score=1.0), run.solution.T_camera_lidar[ONE]
    farther, back = (told(twist, share=0.9) for twist in (AWAY, -AWAY))
    both = replace(back, elsewhere=np.vstack([farther.elsewhere, back.elsewhere]))
    after = follow(wrong, both, told(np.zeros(6), share=0.1))
    degrees, centimetres = pose_difference(after.solution.T_camera_lidar[ONE], right)
    assert degrees < 0.1 and centimetres < 2.0


@pytest.mark.parametrize(("z_score", "late"), [(1e3, False), (1.0, True)])
def test_an_end_that_agrees_less_is_not_taken_and_the_time_limit_holds(
    run: MatchingRun, z_score: float, late: bool
) -> None:
    wrong = replace(displaced(run, AWAY, z_score), is_late=lambda: late)
    assert follow(wrong, told(-AWAY, share=0.9)) is wrong


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
    require_near(result.rig, reference, deg=0.3, cm=18)
    assert result.verdict.status == "WARN"


PAIR = ("front_left", "front_right")


def table_of(seen: Rig, missed: dict[str, float] | None = None) -> Correspondences:
    table = simulate_correspondences(seen, frames=6, matches=100)
    return replace(table, metadata={**table.metadata, "missed": missed or {}})


def matched(data: Dataset, table: Correspondences, terms: Terms = "full") -> MatchingRun:
    return match_in_rounds(data, data.rig, table, Config(), terms=terms, progress=no_progress)


@pytest.fixture(scope="module")
def matched_right(data: Dataset, truth: Rig) -> MatchingRun:
    return matched(data, table_of(truth))


def pair_error(rig: Rig, truth: Rig) -> tuple[float, float]:
    T, true = ({n: each.T_camera_lidar[n] for n in PAIR} for each in (rig, truth))
    a, b = PAIR
    return pose_difference(relative_transform(T[b], T[a]), relative_transform(true[b], true[a]))


def test_a_camera_whose_matches_are_displaced_comes_back_to_its_neighbour(
    data: Dataset, truth: Rig
) -> None:
    off = perturb(truth, rotation_deg=0.3, translation_m=0.0, seed=1).T_camera_lidar
    run = matched(data, table_of(truth.moved_to({PAIR[1]: off[PAIR[1]]})))
    tied = refine_with_camera_pairs(run)
    assert tied.solution.camera_matches.pairs() == [PAIR]
    before, after = (pair_error(each.solution.solved_rig, truth) for each in (run, tied))
    assert before[0] > 0.25
    assert after[0] < before[0] / 2
    alone = tied.solution.without_pairs()
    require_poses(alone.T_camera_lidar, run.solution.T_camera_lidar, atol=0)
    np.testing.assert_allclose(
        tied.solution.T_camera_lidar["left"], run.solution.T_camera_lidar["left"], atol=1e-5
    )
    features = {n: c.get("common_features") for n, c in tied.solution.counts.items()}
    assert features["left"] is None and (features[PAIR[0]] or 0) > 50
    assert {"match_cameras", "solve_pairs"} <= tied.watch.seconds.keys()


@pytest.mark.slow
def test_cameras_are_matched_through_the_lenses_that_were_estimated(
    data: Dataset, truth: Rig, matched_right: MatchingRun
) -> None:
    """With a focal length 2 % too long, matches had agreed on a pair that is 7 cm off."""
    wrong = put_lens_error(truth, "focal", 0.02).cameras[PAIR[0]]
    guess = truth.model_copy(update={"cameras": {**truth.cameras, PAIR[0]: wrong}})
    config = Config(estimate=("focal",))
    run = match_in_rounds(data, guess, table_of(truth), config, progress=no_progress)
    found = refine_with_camera_pairs(run).solution
    right = refine_with_camera_pairs(matched_right).solution
    assert len(found.camera_matches) == pytest.approx(len(right.camera_matches), rel=0.05)
    assert pair_error(found.solved_rig, truth)[1] < 1.0


def test_without_time_terms_or_files_the_run_stays_as_it_is(
    data: Dataset, truth: Rig, matched_right: MatchingRun, tmp_path: Path
) -> None:
    run = matched_right
    late = replace(run, out_of_time=True)
    assert refine_with_camera_pairs(late) is late
    stage1 = matched(data, table_of(truth), "stage1")
    assert refine_with_camera_pairs(stage1) is stage1
    gone = {name: tmp_path / "gone.png" for name in truth.cameras}
    read = calibgraph.load_dataset(SAMPLE, truth)  # as none of them is kept
    frames = tuple(replace(frame, image_paths=gone) for frame in read.frames)
    blind = replace(run, dataset=replace(read, frames=frames))
    assert refine_with_camera_pairs(blind) is blind


@pytest.mark.parametrize(("late_s", "shown"), [(0.0005, True), (0.01, False)])
def test_images_that_a_vehicle_takes_apart_show_no_relative_pose(
    data: Dataset, matched_right: MatchingRun, late_s: float, shown: bool
) -> None:
    """At 10 m/s: they are 5 mm or 10 cm apart."""
    twist = np.r_[0.0, 0.0, 0.0, 10.0, 0.0, 0.0]
    times_s = {PAIR[0]: 0.0, PAIR[1]: late_s}
    drive = [replace(frame, twist=twist, images_after_s=times_s) for frame in data.frames]
    after = refine_with_camera_pairs(
        replace(matched_right, dataset=replace(data, frames=tuple(drive)))
    )
    assert after.solution.camera_matches.pairs() == ([PAIR] if shown else [])


class Halfway:
    """A matcher that finds of each camera half of the way to the truth."""

    rounds, stage1, tracking_rounds = 2, "rig", (0,)

    def __init__(self, truth: Rig) -> None:
        self.truth, self.calls = truth, list[int]()

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        self.calls.append(round_index)
        half = {
            name: T
            @ gtsam.Pose3.Expmap(0.5 * twist_to(self.truth.T_camera_lidar[name], T)).matrix()
            for name, T in rig.T_camera_lidar.items()
        }
        return simulate_correspondences(self.truth.moved_to(half), frames=6, matches=100)


def twist_to(T_there: Array, T_here: Array) -> Array:
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(invert(T_here) @ T_there)))


def test_the_last_round_is_repeated_until_it_stands(data: Dataset, truth: Rig) -> None:
    """The limit is what a PASS allows, 0.1 degrees; from 1.2 off the third and fourth are below."""
    matcher = Halfway(truth)
    guess = perturb(truth, rotation_deg=1.2, translation_m=0.0, seed=0)
    run = match_in_rounds(data, guess, matcher, Config(), progress=no_progress)
    assert max(moved["moved_deg"] for moved in run.rounds[-1].values()) < 0.1
    assert matcher.calls[:3] == [0, 1, 1] and len(run.rounds) <= 6


class Fading(Halfway):
    """It loses a camera after the first rounds."""

    def match(
        self, dataset: Dataset, rig: Rig, *, round_index: int, progress: Progress
    ) -> Correspondences:
        table = super().match(dataset, rig, round_index=round_index, progress=progress)
        own = table.camera_index == table.cameras.index("left")
        return table.select(~own) if len(self.calls) > self.rounds else table


def test_a_camera_that_a_second_start_loses_does_not_fail_the_others(
    data: Dataset, truth: Rig
) -> None:
    run = match_in_rounds(data, truth, Fading(truth), Config(), progress=no_progress)
    assert run.rematch.keys() == truth.cameras.keys() and not run.rematch_failure
    lost = {name for name, check in compare_ends(run) if check.status != "PASS"}
    assert lost == {"left"}


@pytest.fixture(scope="module")
def matched_wrong(data: Dataset, truth: Rig) -> MatchingRun:
    """One camera is three degrees off."""
    off = perturb(truth, rotation_deg=3.0, translation_m=0.3, seed=1).T_camera_lidar
    return matched(data, table_of(truth.moved_to({"left": off["left"]})))


def ended_at(run: MatchingRun, z_score: float) -> MatchingRun:
    """A run with such a z-score of all cameras."""
    run.matcher.tracking_rounds = (0,)
    of_all = replace(
        run.correspondences.findings, z_score=dict.fromkeys(run.guess.cameras, z_score)
    )
    return replace(run, correspondences=run.correspondences.with_findings(of_all))


@pytest.mark.parametrize(("z_score", "taken"), [(9.0, True), (2.0, False)])
@pytest.mark.parametrize("beside", [True, False])
def test_a_second_end_that_agrees_better_is_taken(
    truth: Rig, matched_right: MatchingRun, matched_wrong: MatchingRun,
    beside: bool, z_score: float, taken: bool,
) -> None:  # fmt: skip
    """A camera that is off is matched again: beside the others by the relative pose of the guess,
    from a displaced start, and once more where that ends far away."""
    wrong = ended_at(matched_wrong, 5.0)
    if not beside:
        wrong = replace(wrong, guess=perturb(truth, rotation_deg=3.0, translation_m=0.3, seed=2))
    with patch.object(rounds, "run_again", return_value=ended_at(matched_right, z_score)) as again:
        after = follow_neighbours(wrong) if beside else rounds.rematch(wrong)
    assert again.call_count == 1 + (taken and not beside)
    tried = again.call_args.args[1].T_camera_lidar
    near = {
        name: pose_difference(tried[name], T)[0] < 0.1 for name, T in truth.T_camera_lidar.items()
    }
    assert all(near.values()) == beside
    degrees, _ = pose_difference(
        after.solution.T_camera_lidar["left"], truth.T_camera_lidar["left"]
    )
    assert (degrees < 0.1) == taken
    if not beside:
        ends = [check.status for name, check in compare_ends(after) if name == "left"]
        assert ({*ends} == {"PASS"}) == taken


def test_cameras_that_scatter_alike_follow_none(matched_right: MatchingRun, truth: Rig) -> None:
    """A guess that is off by itself in each camera tells no relative pose."""
    guess = perturb(truth, rotation_deg=3.0, translation_m=0.3, seed=1)
    run = replace(ended_at(matched_right, 5.0), guess=guess)
    with patch.object(rounds, "run_again", side_effect=AssertionError):
        assert follow_neighbours(run) is run


@pytest.mark.usefixtures("no_image_checks")
def test_a_result_keeps_its_camera_matches(data: Dataset, truth: Rig, tmp_path: Path) -> None:
    result = calibgraph.calibrate(data, truth, table_of(truth))
    result.save(tmp_path)
    read = calibgraph.load_calibration(tmp_path)
    assert len(read.camera_matches) == len(result.camera_matches)
    sigmas = result.sigmas("->".join(PAIR))
    assert sigmas is not None and sigmas[0].max() < 0.1 and sigmas[1].max() < 1.5
    replace(result, camera_matches=None).save(tmp_path)
    assert not (tmp_path / "camera_matches.parquet").exists()
    result.camera_matches.save(tmp_path / "camera_matches.parquet")  # not marked as a result's
    with pytest.raises(calibgraph.FileError, match="camera_matches"):
        result.save(tmp_path)
    with pytest.raises(calibgraph.FileError, match="is not the table of"):
        calibgraph.load_calibration(tmp_path)


@pytest.mark.slow
def test_a_camera_without_correspondences_is_calibrated_by_its_neighbour(
    data: Dataset, truth: Rig
) -> None:
    """Its guess is 1 deg and 10 cm off; the camera on the other side sees nothing in common."""
    table = table_of(truth)
    off = perturb(truth, rotation_deg=1, translation_m=0.1, seed=2).T_camera_lidar[PAIR[1]]
    guess = truth.moved_to({PAIR[1]: off})
    without = {n: table.select(table.camera_index != table.cameras.index(n)) for n in truth.cameras}
    result = calibgraph.calibrate(data, guess, without[PAIR[1]])
    assert pair_error(result.rig, truth)[0] < 0.2
    assert result.camera_verdicts[PAIR[1]].status != "PASS"
    result = calibgraph.calibrate(data, guess, without["left"])
    assert result.camera_verdicts["left"].status == "FAIL"
    assert result.sigmas("left") is None


OFFSET_S, READOUT_S = 0.03, 0.02


def one_camera() -> Rig:
    return Rig(cameras={ONE: load_rig(SAMPLE / "reference.yaml").cameras[ONE]})


def late_sample() -> Dataset:
    """The sample with clouds of a LiDAR that moves, as it saw them before the rows were taken."""
    data, rig = load_dataset(SAMPLE, one_camera()), one_camera()
    camera, twists = rig.cameras[ONE], draw_twists(len(data.frames), np.random.default_rng(3))
    clock, T = Clock(OFFSET_S, READOUT_S, camera.height_px), camera.T_camera_lidar
    clouds, images = [], []
    for frame, twist in zip(data.frames, twists, strict=True):
        cloud = frame.load_cloud().astype(np.float64)
        pixels, _ = camera.lens.project(cloud[:, :3] @ T[:3, :3].T + T[:3, 3])
        rows_px = np.clip(np.nan_to_num(pixels[:, 1]), 0, camera.height_px - 1)
        before = displace(cloud[:, :3], twist, clock.times_s(rows_px))
        clouds.append(np.column_stack([before, cloud[:, 3]]))
        images.append(frame.load_image(ONE, camera))
    return dataset_from_arrays(rig, clouds, {ONE: images}, twists_per_s=twists)


@pytest.mark.slow
@pytest.mark.ci
def test_offset_and_readout_are_found_with_the_pose() -> None:
    data, rig = late_sample(), one_camera()
    start = perturb(rig, rotation_deg=1.0, translation_m=0.1, seed=0)
    matcher = StructureMatcher(search_deg=None, search_m=None)
    result = calibrate(data, start, matcher, Config(estimate="clock"))
    offset, readout = result.lens[ONE]
    assert abs(offset.value - OFFSET_S) < 4 * offset.sigma < 0.012
    assert abs(readout.value - READOUT_S) < 4 * readout.sigma < 0.04
    error = evaluate(result.rig, rig).cameras[ONE]
    assert error.translation_error_cm < 3.0  # with a fixed clock 11
    assert error.rotation_error_deg < 0.2


@pytest.mark.slow
def test_a_fixed_clock_is_no_pass_and_names_the_offset() -> None:
    data, rig = late_sample(), one_camera()
    matcher = StructureMatcher(search_deg=None, search_m=None)
    result = calibrate(data, rig, matcher)
    verdict = result.camera_verdicts[ONE]
    assert verdict.status != "PASS"
    (check,) = (c for c in verdict.checks if c.kind == "time_offset")
    assert check.status != "PASS"
    assert "ms later" in check.text and "--estimate offset" in check.text
    known = rig.cameras[ONE].model_copy(update={"time_offset_s": OFFSET_S, "readout_s": READOUT_S})
    right = calibrate(data, Rig(cameras={ONE: known}))  # its search knows the clock, too
    assert evaluate(right.rig, rig).cameras[ONE].translation_error_cm < 5.0
    (check,) = (c for c in right.camera_verdicts[ONE].checks if c.kind == "time_offset")
    assert check.status == "PASS"
