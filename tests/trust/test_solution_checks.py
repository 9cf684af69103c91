"""Checks of a solution: what its matches, frames and places say of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

import calibgraph
from calibgraph import (
    Calibration,
    Config,
    CorrespondenceError,
    Correspondences,
    MatcherErrors,
    Rig,
    concatenate,
    simulate_correspondences,
    solve,
)
from calibgraph.io.frame import Frame
from calibgraph.model.findings import error_components
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.agreement import check_competing_solution
from calibgraph.trust.evidence import Checks, by_camera
from calibgraph.trust.matcher_checks import repeated_file_checks
from calibgraph.trust.solution_checks import weakest_direction
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
    data = calibgraph.load_dataset(SAMPLE, inverted, frames="0")
    result = calibgraph.calibrate(data, matcher=nonsense, time_limit_s=1e-3)
    (check,) = named(result, "front_left", "convention of the guess")
    assert check.status == "FAIL" and "inverted (it is T_lidar_camera)" in check.text
    assert named(result, "front_left", "there was no time")


def test_a_competing_solution_of_the_matches_is_found(pair: Rig) -> None:
    """60 % agree on a wrong extrinsic, 40 % on the right one, which the check names."""
    wrong = calibgraph.perturb(pair, rotation_deg=3, translation_m=0.3, seed=2)
    one, two = simulated(pair, matches=80), simulated(wrong, matches=120, seed=1)
    result = solve(pair, concatenate([one, two]))
    (check,) = named(result, "left", "competing solution")
    assert check.status == "FAIL" and "the other is 3 deg" in check.text


def test_a_competing_solution_just_large_enough_for_a_warning_is_found(pair: Rig) -> None:
    """A quarter agrees on another extrinsic, among as many random outliers."""
    errors = MatcherErrors(outlier_share=0.2)
    wrong = calibgraph.perturb(pair, rotation_deg=5, translation_m=0.5, seed=2)
    table = concatenate(
        [simulated(pair, matches=300, errors=errors), simulated(wrong, matches=100, errors=errors)]
    )
    for seed in range(3):
        solved = solve_joint(pair, table, calibgraph.Config(seed=seed))
        for camera in pair.cameras:
            assert check_competing_solution(solved, camera).value > 0.25


def test_a_competing_solution_may_share_most_matches(pair: Rig) -> None:
    """Far points fit both; near ones decide, and nearly as many of them fit the other."""
    shift = np.zeros((4, 4))
    shift[0, 3] = 0.6
    other = pair.moved_to({name: T + shift for name, T in pair.T_camera_lidar.items()})
    clean = MatcherErrors(noise_px=1.0)
    parts = [
        simulated(rig, frames=6, matches=matches, errors=clean, depth_m=depth_m, seed=seed)
        for seed, (rig, matches, depth_m) in enumerate(
            [(pair, 200, (800.0, 1500.0)), (pair, 20, (5.0, 20.0)), (other, 14, (5.0, 20.0))]
        )
    ]
    check = check_competing_solution(solve_joint(pair, concatenate(parts)), "left")
    assert check.value > 0.25


def test_random_outliers_are_no_competing_solution(pair: Rig) -> None:
    errors = MatcherErrors(outlier_share=0.5)
    solved = solve_joint(pair, simulated(pair, errors=errors))
    assert check_competing_solution(solved, "left").value < 0.1


def test_a_camera_with_all_matches_behind_it_is_one_line(pair: Rig) -> None:
    solved = solve_joint(pair, simulated(pair))
    backwards = {name: np.diag([-1.0, 1, -1, 1]) @ T for name, T in solved.T_camera_lidar.items()}
    with pytest.raises(calibgraph.CorrespondenceError, match="'left': all its .* are behind"):
        solved.objective.scales_at(backwards)


def test_frames_that_are_left_out_alike_are_a_competing_solution(pair: Rig) -> None:
    """Six of ten frames of a camera are displaced alike; the weights leave the other four out."""
    wrong = calibgraph.perturb(pair, rotation_deg=1, translation_m=0.5, seed=2)
    one, two = simulated(pair, frames=10), simulated(wrong, frames=10)
    left = [each.of_camera("left") for each in (one, two)]
    displaced = left[1].select(left[1].frame < 6)
    table = concatenate([one.of_camera("right"), left[0].select(left[0].frame >= 6), displaced])
    result = solve(pair, table)
    (check,) = named(result, "left", "competing solution")
    assert check.status == "FAIL"
    assert result.camera_verdicts["left"].status == "FAIL"
    assert result.camera_verdicts["right"].status != "FAIL"


def test_frames_with_the_same_cloud_or_image_are_reported() -> None:
    data = calibgraph.load_dataset(SAMPLE).select("0:3")
    hashes = {path: digest for frame in data.frames for path, digest in frame.hashes().items()}

    def check(frames: Sequence[Frame], copies: Sequence[tuple[str, str]] = ()) -> Checks:
        run = SimpleNamespace(
            dataset=replace(data, frames=tuple(frames)), hashes=hashes, copies=copies,
            guess=data.rig,
        )  # fmt: skip
        return by_camera(data.rig.cameras, repeated_file_checks(run))

    assert check(data.frames) == {"left": [], "front_left": [], "front_right": []}
    copy = replace(data.frames[0], index=3, name="copy")
    (found,) = check([*data.frames, copy])["left"]
    assert (found.name, found.status) == ("equal files", "WARN")
    assert "000000 and copy have the same image of left" in found.text
    image = {"left": data.frames[0].image_paths["left"]}
    frozen = check([replace(frame, image_paths=frame.image_paths | image) for frame in data.frames])
    (found,) = frozen["left"]
    assert found.text == (
        "frames 000000 and 000001 have the same image of left, and 1 more repeat one; leave "
        "repeats out"
    )
    assert frozen["front_left"] == []
    (found,) = check(data.frames, [("copy", "000000")])["left"]
    assert found.name == "copies" and "frames 000000 and copy" in found.text


def copies(table: Correspondences, number: int) -> Correspondences:
    """A table of one frame, and copies of it under other numbers."""
    frames = [np.full(len(table), k, dtype=np.int64) for k in range(number)]
    return concatenate([replace(table, frame=frame) for frame in frames])


def test_copies_of_a_frame_count_as_one_frame(pair: Rig) -> None:
    table = simulated(pair, frames=8)
    more = copies(table.select(table.frame == 7), 20)
    joined = concatenate([table, replace(more, frame=more.frame + 8)])
    result, plain = solve(pair, joined), solve(pair, table)
    for name, covariance in plain.covariance.items():
        np.testing.assert_allclose(result.covariance[name], covariance, rtol=1e-6, atol=1e-15)
        T = plain.T_camera_lidar[name]
        np.testing.assert_allclose(result.T_camera_lidar[name], T, atol=1e-9)
    assert result.counts["left"]["frames"] == 8
    assert result.counts["left"]["repeated_frames"] == 20
    assert named(result, "left", "they count as one frame each")


def test_a_cloud_that_was_matched_again_counts_once(pair: Rig) -> None:
    """Ten copies of each of three frames, with matches of their own, of most points."""
    table, rng = simulated(pair, frames=3), np.random.default_rng(0)
    parts = []
    for copy in range(10):
        noise = 0.1 * rng.standard_normal(table.pixels_px.shape)
        again = replace(table, frame=table.frame + 3 * copy, pixels_px=table.pixels_px + noise)
        parts.append(again.select(rng.random(len(table)) < 0.9))
    result, alone = solve(pair, concatenate(parts)), solve(pair, table)
    for name in pair.cameras:
        assert result.counts[name]["frames"] == 3 and result.counts[name]["repeated_frames"] == 27
        sigmas = [np.sqrt(np.diag(each.covariance[name])) for each in (result, alone)]
        assert (sigmas[0] > 0.5 * sigmas[1]).all()  # as independent frames: a third and less


def stuck_camera(table: Correspondences, *, first: int) -> Correspondences:
    """The table with the image of a frame in all later ones, while the LiDAR moves 12 cm and on."""
    parts = [table.select(table.frame <= first)]
    image = table.select(table.frame == first)
    for number in range(first + 1, int(table.frame.max()) + 1):
        ahead = np.array([0.12 + 0.002 * number, 0.0, 0.0])
        frame = np.full(len(image), number, dtype=np.int64)
        parts.append(replace(image, frame=frame, points_lidar_m=image.points_lidar_m - ahead))
    return concatenate(parts)


def test_frames_of_a_stuck_camera_count_as_one(pair: Rig) -> None:
    """Twelve of fifteen frames agree on a pose 15 cm off, by one image."""
    result = solve(pair, stuck_camera(simulated(pair, frames=15), first=3))
    for name, verdict in result.camera_verdicts.items():
        assert result.counts[name]["repeated_frames"] == 11
        assert verdict.status != "PASS"
        assert any("a camera or the LiDAR was stuck" in text for text in verdict.reasons)


def test_frames_of_one_place_count_as_one_frame(pair: Rig) -> None:
    """Named in the metadata, as by ``calibrate`` where the vehicle stands."""
    table = simulated(pair, frames=10)
    standing = replace(table, metadata={**table.metadata, "stationary": [[2, 3, 4], [7, 9]]})
    result = solve(pair, standing)
    assert result.counts["left"]["frames"] == 7 and result.counts["left"]["repeated_frames"] == 3
    with pytest.raises(CorrespondenceError, match="stationary"):
        replace(table, metadata={**table.metadata, "stationary": [[2, "3"]]})


PLACES = [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11], [12, 13, 14]]
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.3, outlier_share=0.1)
CONFIG = Config(learnt_weights=False)


def five_places(rig: Rig) -> Correspondences:
    """As the matcher ``structure`` states them, without the errors that it states."""
    table = simulate_correspondences(rig, frames=15, matches=150, errors=ERRORS)
    stated = error_components().matchers["structure"]
    return replace(table, metadata={**table.metadata, **stated, "places": PLACES})


def displaced(table: Correspondences, place: int, deg: float, m: float) -> Correspondences:
    """The cloud of one place turned about the vertical, and shifted along the street."""
    T = gtsam.Pose3.Expmap(np.array([0, 0, np.radians(deg), m, 0, 0])).matrix()
    points, there = table.points_lidar_m.copy(), np.isin(table.frame, PLACES[place])
    points[there] = points[there] @ T[:3, :3].T + T[:3, 3]
    return replace(table, points_lidar_m=points)


def place_checks(result: Calibration, camera: str) -> dict[str | None, tuple[str, str]]:
    """Status and text by kind."""
    checks = result.camera_verdicts[camera].checks
    return {c.kind: (c.status, c.text) for c in checks if (c.kind or "").startswith("place_")}


def test_good_places_pass(pair: Rig) -> None:
    result = solve(pair, five_places(pair), CONFIG)
    for camera in pair.cameras:
        found = place_checks(result, camera)
        assert {kind: status for kind, (status, _) in found.items()} == {
            "place_distance": "PASS",
            "place_inliers": "PASS",
        }


@pytest.mark.parametrize(("deg", "m"), [(0.3, 0.06), (1.0, 0.2)])
def test_a_displaced_place_is_named(pair: Rig, deg: float, m: float) -> None:
    result = solve(pair, displaced(five_places(pair), 3, deg, m), CONFIG)
    for camera in pair.cameras:
        found = place_checks(result, camera)
        worse = [text for status, text in found.values() if status == "WARN"]
        assert worse and all("place 4 (frames 9 to 11)" in text for text in worse)
        assert all(status != "FAIL" for status, _ in found.values())


def test_of_two_places_none_can_be_told_to_be_wrong(pair: Rig) -> None:
    table = five_places(pair)
    table = displaced(table.select(table.frame < 6), 0, 1.0, 0.2)
    result = solve(pair, replace(table, metadata={**table.metadata, "places": PLACES[:2]}), CONFIG)
    assert not place_checks(result, "left")
    assert not named(result, "left", "distance of a place")


def test_the_weakest_direction_is_named() -> None:
    sigmas = np.array([1e-4, 1e-4, 1e-4, 0.001, 0.001, 0.038])
    assert weakest_direction(np.diag(sigmas**2)) == (
        "shift along z (the optical axis) 3.8 cm (1 sigma)"
    )


def test_empty_parts_of_image_and_depth_are_named(pair: Rig) -> None:
    table = simulated(pair, depth_m=(9.0, 14.0))
    right = table.select(table.pixels_px[:, 0] > 500)
    words = "; ".join(solve(pair, right).weaknesses["left"])
    assert "the left third of the image has no matches" in words
    assert "nothing nearer than 9" in words and "nothing farther than 14 m" in words
    assert "middle third" not in words and "hard to distinguish" in words
