"""The matcher `structure` on the sample; from its own guess, as a user calls it: test_docs.py."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Rig, StructureMatcher
from calibgraph.errors import DatasetError
from calibgraph.matching.protocol import Start
from calibgraph.matching.structure import global_search
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.model.geometry import transform
from calibgraph.progress import no_progress
from calibgraph.rounds import match_in_rounds
from tests.conftest import SAMPLE, Call, require_near, stereo_relative_pose
from tests.matching.structure.data import (
    far_from,
    never,
    with_half_images,
    with_noise_images,
    with_points_shuffled,
    without_search,
)


def locate(data: calibgraph.Dataset, rig: Rig) -> Start:
    return StructureMatcher().locate(data, rig, out_of_time=never, progress=no_progress)


@pytest.mark.parametrize("most", [1, 2000])
def test_clouds_with_too_few_points_are_refused_before_the_search(
    most: int, truth: Rig, tmp_path: Path
) -> None:
    thinned = with_points_shuffled(calibgraph.load_dataset(SAMPLE, truth), tmp_path, most)
    with pytest.raises(DatasetError, match="points have .* neighbourhoods with structure"):
        locate(thinned, truth)


@pytest.mark.ci
@pytest.mark.slow
def test_cameras_are_found_from_far_away(truth: Rig) -> None:
    far = far_from(truth, seed=1)
    rig = Rig(cameras={name: far.cameras[name] for name in ("front_left", "left")})
    start = locate(calibgraph.load_dataset(SAMPLE, rig), rig)
    assert start.findings.found.keys() == rig.cameras.keys()
    assert start.first_round == 3
    # the reach of the next round
    require_near(start.rig, truth, deg=0.7, cm=20)


@pytest.mark.slow
def test_a_known_relative_pose_locates_a_camera(truth: Rig) -> None:
    """One camera has its true guess; the guess of the other is beyond the range."""
    names = ["front_left", "front_right"]
    pair = stereo_relative_pose(truth, *names[::-1])
    turned = transform(Rotation.from_euler("y", 60.0, degrees=True))
    cameras = {n: truth.cameras[n] for n in names}
    cameras[names[1]] = cameras[names[1]].moved_to(turned @ truth.T_camera_lidar[names[1]])
    rig = Rig(cameras=cameras, relative_poses=(pair,))
    start = locate(calibgraph.load_dataset(SAMPLE, rig).select("0:3"), rig)
    assert names[1] in start.findings.found
    error = calibgraph.evaluate(start.rig, truth).cameras[names[1]]
    assert error.rotation_error_deg < 0.7


@pytest.mark.slow
def test_a_camera_whose_images_show_noise_is_missed(
    truth: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(global_search, "SEARCHES", 1)
    rig = Rig(cameras={name: truth.cameras[name] for name in ("front_left", "left")})
    data = calibgraph.load_dataset(SAMPLE, rig).select("0")
    start = locate(with_noise_images(data, "left", tmp_path), rig)
    assert start.findings.missed.keys() == {"left"}
    np.testing.assert_allclose(
        start.rig.T_camera_lidar["left"], truth.T_camera_lidar["left"], atol=1e-12
    )
    assert start.first_round == 3  # the other is at its pose by the fine levels


@pytest.mark.slow
def test_missed_cameras_fail_later_solves_too(truth: Rig, tmp_path: Path, call: Call) -> None:
    """A search of so small a range, so far off, finds nothing."""
    rig, table = tmp_path / "rig.yaml", tmp_path / "matches.parquet"
    far_from(truth, seed=1).save(rig)
    near = ("--search-deg", "0.5", "--search-m", "0.05", "--frames", "0:2")
    code, _, err = call("match", SAMPLE, "--rig", rig, "--out", table, *near)
    assert code == 1 and "not found: " in err, err
    missed = set(calibgraph.load_correspondences(table).metadata["missed"])
    assert missed and missed <= set(truth.cameras)
    code, _, err = call("solve", rig, table, "--out", tmp_path / "out")
    assert code == 1
    assert "not found: where image and cloud agree best" in err


@pytest.mark.slow
def test_matches_are_independent_of_the_order_of_points(tmp_path: Path) -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    given, other = (
        match_in_rounds(d, matcher=without_search(LEVELS[:2]), progress=no_progress)
        for d in (data, with_points_shuffled(data, tmp_path))
    )
    errors = calibgraph.evaluate(given.solution.solved_rig, other.solution.solved_rig)
    for error in errors.cameras.values():
        assert error.rotation_error_deg < 0.02
        assert error.translation_error_cm < 0.5


@pytest.mark.slow
def test_images_of_320_pixels_are_matched(tmp_path: Path, truth: Rig) -> None:
    """The last rounds reach few of their pixels only, by their angles."""
    data = calibgraph.load_dataset(SAMPLE)
    data = with_half_images(data, "left", truth.cameras["left"], tmp_path)
    guess = calibgraph.perturb(data.rig, rotation_deg=0.5, translation_m=0.05, seed=0)
    found = match_in_rounds(data, guess, without_search(LEVELS[3:]), progress=no_progress)
    error = calibgraph.evaluate(found.solution.solved_rig, data.rig).cameras["left"]
    pixel_deg = np.degrees(1 / data.rig.cameras["left"].intrinsics_px.fx)
    assert error.rotation_error_deg < pixel_deg
    assert error.translation_error_cm < 10


@pytest.mark.slow
def test_the_number_of_threads_does_not_matter(truth: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    data = calibgraph.load_dataset(SAMPLE, truth)
    tables = []
    for threads in (1, 3):
        pool = partial(ThreadPoolExecutor, threads)
        monkeypatch.setattr("calibgraph.matching.structure.matcher.core_pool", pool)
        matcher = without_search(LEVELS[3:4])
        tables.append(matcher.match(data, data.rig, round_index=0, progress=no_progress))
    for name in ("pixels_px", "points_lidar_m", "information_px", "frame"):
        np.testing.assert_array_equal(*(getattr(table, name) for table in tables))


@pytest.mark.usefixtures("no_image_checks")
def test_a_camera_that_sees_none_of_the_cloud_is_named(truth: Rig) -> None:
    two = Rig(cameras={name: truth.cameras[name] for name in ("front_left", "left")})
    away = np.diag([-1.0, 1.0, -1.0, 1.0]) @ truth.T_camera_lidar["left"]
    data = calibgraph.load_dataset(SAMPLE, two.moved_to({"left": away}), frames="0")
    result = calibgraph.calibrate(data, matcher=without_search(LEVELS[-2:]))
    (check,) = (c for c in result.camera_verdicts["left"].checks if c.name == "correspondences")
    assert check.status == "FAIL" and "the cloud lies where T_camera_lidar looks" in check.text


def test_a_result_of_fewer_rounds_is_partial() -> None:
    one = Rig(cameras={"left": calibgraph.load_rig(SAMPLE).cameras["left"]})
    data = calibgraph.load_dataset(SAMPLE, one, frames="0:2")
    result = calibgraph.calibrate(data, matcher=without_search(LEVELS[:3]), time_limit_s=1e-3)
    assert len(result.rounds) == 1
    assert result.verdict.status in ("WARN", "FAIL")
    assert any(
        "partial: there was no time for 2 rounds of matching" in reason
        for reason in result.verdict.reasons
    )


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        ({"search_deg": None}, "both ranges"),
        ({"search_m": None}, "both ranges"),
        ({"search_deg": 90.0}, "up to 45 deg"),
        ({"search_m": -1.0}, "found 20 deg and -1 m"),
        ({"search_deg": 0.0}, "found 0 deg and 1.5 m; give 0 for both"),
        ({"search_m": float("nan")}, "found 20 deg and nan m"),
    ],
)
def test_ranges_are_checked(ranges: dict[str, float | None], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        StructureMatcher(**ranges)  # type: ignore[arg-type]
