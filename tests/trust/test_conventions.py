from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.trust.conventions import (
    convention_error_between,
    correct_guess,
    in_words,
    likely_intended_guess,
    undo_convention_errors,
)
from tests.conftest import SAMPLE, make_camera

SLOW = pytest.mark.slow


ERRORS = tuple(undo_convention_errors(np.eye(4)))


def test_every_error_has_its_words_and_is_recognised_by_undoing_it() -> None:
    """The corrections of a wrong guess hold the right one, under the error's name."""
    truth = make_camera((0.8, 0.3, -0.4), yaw_deg=50).T_camera_lidar
    found = {error: convention_error_between(mistaken(error, truth), truth) for error in ERRORS}
    assert found == {error: error for error in ERRORS}
    assert len({in_words(error) for error in ERRORS}) == len(ERRORS) == 12 + 23


@pytest.mark.parametrize(
    ("error", "seed"),
    [
        ("inverse", 1),
        ("cloud-ahead-right-down", 3),
        ("camera-upside-down", 4),
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
    assert likely_intended_guess(one_frame(), wrong) == (
        f"the images fit clearly better if {in_words(error)}; undo it with calibgraph rig RIG "
        f"--correct {error} --out FILE.yaml"
    )
    undone = correct_guess(wrong, [error])
    for name, camera in undone.cameras.items():
        np.testing.assert_allclose(camera.T_camera_lidar, rough.T_camera_lidar[name], atol=1e-9)


def test_mirrored_images_are_named(tmp_path: Path) -> None:
    """The principal point is that of the mirrored image, so that only its content is wrong."""
    copy = tmp_path / "sample"
    shutil.copytree(SAMPLE, copy)
    for path in (copy / "cameras" / "left").iterdir():
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path)), 1))
    found = likely_intended_guess(calibgraph.load_dataset(copy, frames="0:3"), rough_guess(5))
    assert found is not None and found.startswith("the images of left are mirrored")


@pytest.mark.parametrize(("rotation_deg", "translation_m"), [(4.0, 0.3), (20.0, 1.5)])
def test_no_mistake_is_seen_in_a_guess_that_is_only_rough(
    rotation_deg: float, translation_m: float
) -> None:
    rough = rough_guess(6, rotation_deg, translation_m)
    assert likely_intended_guess(one_frame(), rough) is None


def one_frame() -> calibgraph.Dataset:
    """The first of the sample: a mistake is seen in one already."""
    return calibgraph.load_dataset(SAMPLE, frames="0")


def rough_guess(seed: int, rotation_deg: float = 4.0, translation_m: float = 0.3) -> calibgraph.Rig:
    """The sample's rig, some way off."""
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
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
