from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.trust.conventions import (
    convention_error_between,
    likely_intended_guess,
    undo_convention_errors,
)
from tests.conftest import SAMPLE, make_camera

SLOW = pytest.mark.slow


@pytest.mark.parametrize("words", undo_convention_errors(np.eye(4)))
def test_every_convention_error_is_recognised_by_undoing_it(words: str) -> None:
    """The corrections of a wrong guess hold the right one, under the error's name."""
    truth = make_camera((0.8, 0.3, -0.4), yaw_deg=50).T_camera_lidar
    assert convention_error_between(mistaken(words, truth), truth) == words


@pytest.mark.parametrize(
    ("words", "seed"),
    [
        ("the guess is inverted (it is T_lidar_camera)", 1),
        pytest.param(
            "the guess is of camera axes forward, left, up, not right, down, forward",
            2,
            marks=SLOW,
        ),
        pytest.param(
            "the LiDAR's axes are turned by 180 deg about z (its x points backward)", 3, marks=SLOW
        ),
        pytest.param(
            "the LiDAR's axes are turned by 90 deg about z (its x points right)", 4, marks=SLOW
        ),
    ],
)
def test_a_mistake_is_recognised_by_the_images_at_a_rough_guess(words: str, seed: int) -> None:
    rough = rough_guess(seed)
    T = {name: mistaken(words, T) for name, T in rough.T_camera_lidar.items()}
    found = likely_intended_guess(one_frame(), rough.moved_to(T))
    assert found == f"the images fit clearly better if {words}"


def test_the_camera_is_named_if_only_its_guess_is_wrong() -> None:
    rough = rough_guess(5)
    wrong = np.linalg.inv(rough.T_camera_lidar["left"])
    found = likely_intended_guess(one_frame(), rough.moved_to({"left": wrong}))
    assert found == (
        "the images of left fit clearly better if the guess is inverted (it is T_lidar_camera)"
    )


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


def mistaken(words: str, truth: np.ndarray) -> np.ndarray:
    """The guess that has the convention error of that name."""
    inverse, wrong = np.linalg.inv(truth), truth.copy()
    x, y, z, w = Rotation.from_matrix(truth[:3, :3]).as_quat()
    if "in millimetres" in words:
        wrong = inverse if "inverted" in words else wrong
        wrong[:3, 3] *= 1000
    elif words.endswith("of camera axes forward, left, up"):
        wrong = np.linalg.inv(np.linalg.inv(T_OPTICAL_LINK) @ truth)
    elif "inverted" in words:
        wrong = inverse
    elif "of camera axes" in words:
        wrong = np.linalg.inv(T_OPTICAL_LINK) @ truth
    elif "turned by" in words:
        degrees = 180 if "180" in words else 90 if "right" in words else -90
        wrong[:3, :3] = truth[:3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    elif "position" in words:
        wrong[:3, 3] = inverse[:3, 3]
    elif "transposed" in words:
        wrong[:3, :3] = truth[:3, :3].T
    elif "w x y z that was read as x y z w" in words:
        wrong[:3, :3] = Rotation.from_quat([w, x, y, z]).as_matrix()
    else:
        wrong[:3, :3] = Rotation.from_quat([y, z, w, x]).as_matrix()
    return wrong
