"""Mistakes in guess and inputs: named before the search, by its images, and by the result."""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Intrinsics, MatcherErrors, Rig, load_calibration, load_rig, solve
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.trust.conventions import (
    convention_error_between,
    correct_guess,
    in_words,
    likely_intended_guess,
    undo_convention_errors,
)
from calibgraph.trust.guess import compare_with_other_guesses, describe_other_frame
from calibgraph.trust.inputs import check_inputs
from tests.conftest import SAMPLE, Call, make_camera
from tests.trust.conftest import named, simulated

RIG = load_rig(SAMPLE)
TWO = ("front_left", "left")


def with_principal_point(cx: float, cy: float) -> calibgraph.Rig:
    left = RIG.cameras["left"]
    lens = Intrinsics(**{**left.intrinsics_px.model_dump(), "cx": cx, "cy": cy})
    return Rig(cameras={"left": left.model_copy(update={"intrinsics_px": lens})})


def test_the_sample_has_no_warning() -> None:
    assert check_inputs(calibgraph.load_dataset(SAMPLE), RIG) == ()


def test_a_rig_whose_cameras_all_see_no_point_is_refused_before_the_search(
    tmp_path: Path, call: Call
) -> None:
    folder = Path(shutil.copytree(SAMPLE, tmp_path / "sample"))
    cloud = np.load(folder / "lidar" / "000000.npy")
    np.save(folder / "lidar" / "000000.npy", cloud * [-1, -1, 1, 1])
    Rig(cameras={name: RIG.cameras[name] for name in TWO}).save(folder / "rig.yaml")
    code, _, err = call("calibrate", folder, "--frames", "0", "--out", folder / "out")
    assert code == 2
    assert err.count("turned by 180 deg about z (its x points behind, y right, z up)") == 1
    assert "left: by the guess, no point of the cloud lies in the image" in err
    assert not (folder / "out").exists()


def test_a_camera_of_several_that_sees_no_point_is_a_warning() -> None:
    T = RIG.T_camera_lidar["left"].copy()
    T[:3, :3] = np.diag([-1.0, 1.0, -1.0]) @ T[:3, :3]  # to the right, where the LiDAR is blind
    warnings = check_inputs(calibgraph.load_dataset(SAMPLE), RIG.moved_to({"left": T}))
    assert warnings == ("left: by the guess, no point of the cloud lies in the image",)


@pytest.mark.usefixtures("no_image_checks")
def test_warnings_are_logged_and_recorded_and_nothing_is_printed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    rig = with_principal_point(80, 45)
    data = calibgraph.load_dataset(SAMPLE, rig, frames="0:2")
    table = calibgraph.simulate_correspondences(rig, frames=2, matches=200, seed=1)
    with caplog.at_level(logging.WARNING, "calibgraph"):
        result = calibgraph.calibrate(data, rig, table)
    assert result.warnings == tuple(caplog.messages)
    assert "principal point (80, 45)" in result.warnings[0]
    assert load_calibration(result.save(tmp_path)).warnings == result.warnings
    assert capfd.readouterr() == ("", "")


def test_an_inverted_guess_is_named_though_the_result_is_right(pair: Rig) -> None:
    poses = {name: np.linalg.inv(T) for name, T in pair.T_camera_lidar.items()}
    result = solve(pair.moved_to(poses), simulated(pair))
    assert result.verdict.status == "PASS"
    assert any("it seems that the guess is inverted" in reason for reason in result.verdict.reasons)


def test_swapped_cameras_are_named(pair: Rig) -> None:
    """Half a metre apart, from 2 deg and 20 cm; and the same the right way round."""
    right = pair.T_camera_lidar
    swapped = dict(zip(right, reversed(right.values()), strict=True))
    guess = calibgraph.perturb(pair, rotation_deg=2, translation_m=0.2, seed=3).T_camera_lidar
    for _, check in compare_with_other_guesses(guess, right):
        assert check.status == "PASS"
    for _, check in compare_with_other_guesses(guess, swapped):
        assert check.status != "PASS" and "are their images swapped" in check.text
    # Of one of them alone, whose own guess is as far away as the other's is near.
    good = calibgraph.perturb(pair, rotation_deg=0.5, translation_m=0.05, seed=3).T_camera_lidar
    ((name, check),) = compare_with_other_guesses(good, {"left": swapped["left"]})
    assert (name, check.status) == ("left", "FAIL")
    # Lenses of one housing, and results that are off by more than these are apart.
    near = {"left": np.eye(4), "right": np.eye(4)}
    near["right"][0, 3] = 0.02
    for results in (near, dict(zip(near, reversed(near.values()), strict=True))):
        check = dict(compare_with_other_guesses(near, results))["left"]
        assert check.status == "PASS"
    for guesses, results in (({"left": guess["left"]}, {"left": right["left"]}), (guess, {})):
        assert not [*compare_with_other_guesses(guesses, results)]


@pytest.mark.parametrize(
    ("degrees", "metres", "false_fails", "named"),
    [(2.0, 0.2, 0.002, 0.9), (10.0, 0.5, 0.01, 0.1), (20.0, 1.5, 0.01, 0.0)],
)
def test_a_swap_is_named_as_far_as_the_guesses_can_show_it(
    pair: Rig, degrees: float, metres: float, false_fails: float, named: float
) -> None:
    right = pair.T_camera_lidar
    swapped = dict(zip(right, reversed(right.values()), strict=True))
    statuses: dict[bool, list[str]] = {True: [], False: []}
    for seed in range(100):
        drawn = calibgraph.perturb(
            pair, rotation_deg=degrees, translation_m=metres, seed=seed, uniform=True
        )
        for is_swapped, results in ((False, right), (True, swapped)):
            check = dict(compare_with_other_guesses(drawn.T_camera_lidar, results))["left"]
            statuses[is_swapped].append(check.status)
    assert statuses[False].count("FAIL") <= false_fails * 100
    assert statuses[True].count("FAIL") >= named * 100


def test_points_in_millimetres_fail(pair: Rig) -> None:
    table = simulated(pair, errors=MatcherErrors())
    huge = replace(table, points_lidar_m=1000 * table.points_lidar_m)
    result = solve(pair, huge)
    assert named(result, "left", "are the clouds in millimetres?")[0].status == "FAIL"


def test_guesses_from_another_frame_of_the_vehicle_are_named(pair: Rig) -> None:
    """Of rough guesses, of one camera too; not of guesses that differ from each other."""
    T_lidar_base = np.eye(4)
    T_lidar_base[:3, 3] = -1.1, 0.0, -1.9
    rough = calibgraph.perturb(pair, rotation_deg=2, translation_m=0.2, seed=1)
    from_base = {name: T @ T_lidar_base for name, T in rough.T_camera_lidar.items()}
    text = describe_other_frame(from_base, pair.T_camera_lidar)
    assert text.startswith("all cameras are moved as if the guess were of another frame")
    left = {"left": pair.T_camera_lidar["left"]}
    assert describe_other_frame(from_base, left).startswith("the camera is moved as if")
    exact = {name: T @ T_lidar_base for name, T in left.items()}
    assert "x 1.10, y 0.00, z 1.90 m" in describe_other_frame(exact, left)
    apart = from_base | {"right": pair.T_camera_lidar["right"]}
    assert describe_other_frame(apart, pair.T_camera_lidar) == ""
    assert describe_other_frame(rough.T_camera_lidar, pair.T_camera_lidar) == ""
    guess = pair.moved_to({name: T @ T_lidar_base for name, T in pair.T_camera_lidar.items()})
    result = solve(guess, simulated(pair, frames=2))
    assert named(result, "right", "all cameras are moved as if")[0].status == "WARN"


SLOW = pytest.mark.slow
ERRORS = tuple(undo_convention_errors(np.eye(4)))


def test_every_error_has_its_words_and_is_recognised_by_undoing_it() -> None:
    """The corrections of a wrong guess hold the right one, under the error's name."""
    truth = make_camera((0.8, 0.3, -0.4), yaw_deg=50).T_camera_lidar
    guesses = {error: {"": mistaken(error, truth)} for error in ERRORS}
    found = {e: convention_error_between(guess, {"": truth}) for e, guess in guesses.items()}
    assert found == {error: error for error in ERRORS}
    assert len({in_words(error) for error in ERRORS}) == len(ERRORS) == 12 + 23


@pytest.mark.parametrize(
    ("error", "seed"),
    [
        ("inverse", 1),
        pytest.param("camera-upside-down", 4, marks=SLOW),
        pytest.param("cloud-ahead-right-down", 3, marks=SLOW),
        pytest.param("camera-flu", 2, marks=SLOW),
        pytest.param("cloud-behind-right-up", 3, marks=SLOW),
        pytest.param("cloud-right-ahead-up", 4, marks=SLOW),
        pytest.param("cloud-right-down-ahead", 5, marks=SLOW),
        pytest.param("cloud-ahead-down-left", 6, marks=SLOW),
        pytest.param("cloud-down-left-ahead", 7, marks=SLOW),
        pytest.param("camera-clockwise", 8, marks=SLOW),
        pytest.param("camera-counterclockwise", 9, marks=SLOW),
    ],
)
def test_a_mistake_is_recognised_by_the_images_at_a_rough_guess(error: str, seed: int) -> None:
    rough = rough_guess(seed)
    T = {name: mistaken(error, T) for name, T in rough.T_camera_lidar.items()}
    wrong = rough.moved_to(T)
    one_frame = calibgraph.load_dataset(SAMPLE, rough, frames="0")  # a mistake is seen in one
    found = likely_intended_guess(one_frame, wrong)
    assert f"fit clearly better if {in_words(error)}; undo it" in found
    assert f"--correct {error} " in found
    undone = correct_guess(wrong, [error])
    for name, camera in undone.cameras.items():
        np.testing.assert_allclose(camera.T_camera_lidar, rough.T_camera_lidar[name], atol=1e-9)


def test_mirrored_images_are_named(tmp_path: Path) -> None:
    """The principal point is that of the mirrored image, so that only its content is wrong."""
    copy = tmp_path / "sample"
    shutil.copytree(SAMPLE, copy)
    for path in (copy / "cameras" / "left").iterdir():
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path)), 1))
    rough = rough_guess(5)
    found = likely_intended_guess(calibgraph.load_dataset(copy, rough, frames="0"), rough)
    assert found is not None and found.startswith("the images of left are mirrored")


@pytest.mark.parametrize(
    ("rotation_deg", "translation_m"), [pytest.param(4.0, 0.3, marks=SLOW), (20.0, 1.5)]
)
def test_no_mistake_is_seen_in_a_guess_that_is_only_rough(
    rotation_deg: float, translation_m: float
) -> None:
    rough = rough_guess(6, rotation_deg, translation_m)
    one_frame = calibgraph.load_dataset(SAMPLE, rough, frames="0")
    assert likely_intended_guess(one_frame, rough) is None


def rough_guess(seed: int, rotation_deg: float = 4.0, translation_m: float = 0.3) -> calibgraph.Rig:
    """Two cameras of the sample, some way off."""
    whole = calibgraph.load_rig(SAMPLE / "reference.yaml")
    truth = Rig(cameras={name: whole.cameras[name] for name in TWO})
    return calibgraph.perturb(
        truth, rotation_deg=rotation_deg, translation_m=translation_m, seed=seed
    )


def mistaken(error: str, truth: np.ndarray) -> np.ndarray:
    """The guess that has the convention error of that name."""
    inverse, wrong = np.linalg.inv(truth), truth.copy()
    x, y, z, w = Rotation.from_matrix(truth[:3, :3]).as_quat()
    kind, *sides = error.split("-")
    if "millimetres" in error:
        wrong = inverse if kind == "inverse" else wrong
        wrong[:3, 3] *= 1000
    elif error == "inverse-camera-flu":
        wrong = np.linalg.inv(np.linalg.inv(T_OPTICAL_LINK) @ truth)
    elif error == "inverse":
        wrong = inverse
    elif error == "camera-flu":
        wrong = np.linalg.inv(T_OPTICAL_LINK) @ truth
    elif kind == "cloud":
        axes = {"ahead": (1, 0, 0), "behind": (-1, 0, 0), "left": (0, 1, 0), "right": (0, -1, 0),
                "up": (0, 0, 1), "down": (0, 0, -1)}  # fmt: skip
        wrong[:3, :3] = truth[:3, :3] @ np.array([axes[side] for side in sides])
    elif kind == "camera":
        # What is to the right of a camera that was turned clockwise is above in the guess's axes.
        degrees = {"upside": 180, "clockwise": 90, "counterclockwise": -90}[sides[0]]
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        wrong = turn @ truth
    elif error == "position":
        wrong[:3, 3] = inverse[:3, 3]
    elif error == "transposed":
        wrong[:3, :3] = truth[:3, :3].T
    elif error == "wxyz":
        wrong[:3, :3] = Rotation.from_quat([w, x, y, z]).as_matrix()
    else:
        wrong[:3, :3] = Rotation.from_quat([y, z, w, x]).as_matrix()
    return wrong
