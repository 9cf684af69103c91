"""Cameras tied by their images after the rounds of matching."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Correspondences, Dataset, Rig, perturb, simulate_correspondences
from calibgraph.matching.run import MatchingRun
from calibgraph.model.config import Config, Terms
from calibgraph.model.geometry import pose_difference, relative_transform
from calibgraph.overlaps import refine_with_camera_pairs
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from tests.conftest import SAMPLE

PAIR = ("front_left", "front_right")


@pytest.fixture(scope="module")
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


@pytest.fixture(scope="module")
def data(truth: Rig) -> Dataset:
    return calibgraph.load_dataset(SAMPLE, truth)


def table_of(seen: Rig, missed: dict[str, float] | None = None) -> Correspondences:
    table = simulate_correspondences(seen, frames=6, matches=100)
    return replace(table, metadata={**table.metadata, "missed": missed or {}})


def matched(data: Dataset, table: Correspondences, terms: Terms = "full") -> MatchingRun:
    return match_in_rounds(data, data.rig, table, Config(), terms=terms, progress=no_progress)


def pair_error(rig: Rig, truth: Rig) -> tuple[float, float]:
    T, true = ({n: each.T_camera_lidar[n] for n in PAIR} for each in (rig, truth))
    a, b = PAIR
    return pose_difference(relative_transform(T[b], T[a]), relative_transform(true[b], true[a]))


def test_a_camera_whose_matches_are_displaced_comes_back_to_its_neighbour(
    data: Dataset, truth: Rig
) -> None:
    off = perturb(truth, rotation_deg=0.3, translation_m=0.0, seed=1).T_camera_lidar
    run = matched(data, table_of(truth.moved_to({PAIR[1]: off[PAIR[1]]})))
    tied = refine_with_camera_pairs(run, no_progress)
    assert tied.solution.camera_matches is not None
    assert tied.solution.camera_matches.pairs() == [PAIR]
    before, after = (pair_error(each.solution.solved_rig, truth) for each in (run, tied))
    assert before[0] > 0.25
    assert after[0] < before[0] / 2
    alone = tied.solution.without_pairs()
    for name, T in run.solution.T_camera_lidar.items():
        np.testing.assert_array_equal(alone.T_camera_lidar[name], T)
    np.testing.assert_allclose(
        tied.solution.T_camera_lidar["left"], run.solution.T_camera_lidar["left"], atol=1e-5
    )
    features = {n: c.get("common_features") for n, c in tied.solution.counts.items()}
    assert features["left"] is None and (features[PAIR[0]] or 0) > 50
    assert {"match_cameras", "solve_pairs"} <= tied.watch.seconds.keys()


def test_cameras_are_matched_through_the_lenses_that_were_estimated(
    data: Dataset, truth: Rig
) -> None:
    """With a focal length 2 % too long, matches had agreed on a pair that is 7 cm off."""
    camera = truth.cameras[PAIR[0]]
    lens = camera.intrinsics_px
    longer = lens.model_copy(update={"fx": 1.02 * lens.fx, "fy": 1.02 * lens.fy})
    wrong = camera.model_copy(update={"intrinsics_px": longer})
    guess = truth.model_copy(update={"cameras": {**truth.cameras, PAIR[0]: wrong}})
    config = Config(estimate=("focal",))
    run = match_in_rounds(data, guess, table_of(truth), config, progress=no_progress)
    found = refine_with_camera_pairs(run, no_progress).solution
    right = refine_with_camera_pairs(matched(data, table_of(truth)), no_progress).solution
    assert found.camera_matches is not None and right.camera_matches is not None
    assert len(found.camera_matches) == pytest.approx(len(right.camera_matches), rel=0.05)
    assert pair_error(found.solved_rig, truth)[1] < 1.0


def test_without_time_terms_or_files_the_run_stays_as_it_is(
    data: Dataset, truth: Rig, tmp_path: Path
) -> None:
    table = table_of(truth)
    run = matched(data, table)
    late = replace(run, out_of_time=True)
    assert refine_with_camera_pairs(late, no_progress) is late
    stage1 = matched(data, table, "stage1")
    assert refine_with_camera_pairs(stage1, no_progress) is stage1
    gone = {name: tmp_path / "gone.png" for name in truth.cameras}
    frames = tuple(replace(frame, image_paths=gone) for frame in data.frames)
    blind = replace(run, dataset=replace(data, frames=frames))
    assert refine_with_camera_pairs(blind, no_progress) is blind


@pytest.mark.usefixtures("no_image_checks")
def test_a_result_keeps_its_camera_matches(data: Dataset, truth: Rig, tmp_path: Path) -> None:
    result = calibgraph.calibrate(data, truth, table_of(truth))
    assert result.camera_matches is not None
    result.save(tmp_path)
    read = calibgraph.load_calibration(tmp_path)
    assert read.camera_matches is not None
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
