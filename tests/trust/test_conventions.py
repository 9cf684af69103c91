from __future__ import annotations

import numpy as np
import pytest

import calibgraph
from calibgraph.trust.conventions import (
    OPTICAL_FROM_BODY,
    convention_error_between,
    likely_intended_guess,
    undo_convention_errors,
)
from tests.conftest import SAMPLE, make_camera


@pytest.mark.parametrize("words", undo_convention_errors(np.eye(4)))
def test_every_convention_error_is_recognised_by_undoing_it(words: str) -> None:
    """The corrections of a wrong guess hold the right one, under the error's name."""
    truth = make_camera((0.8, 0.3, -0.4), yaw_deg=50).T_camera_lidar
    assert convention_error_between(mistaken(words, truth), truth) == words


def test_an_inverted_guess_is_recognised_by_the_images() -> None:
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    data = calibgraph.load_dataset(SAMPLE).select("0:2")
    inverted = {name: np.linalg.inv(T) for name, T in truth.T_camera_lidar.items()}
    error = likely_intended_guess(data, truth.moved_to(inverted))
    assert error == "inverted (it is T_lidar_camera)"


def mistaken(words: str, truth: np.ndarray) -> np.ndarray:
    """The guess that has the convention error of that name."""
    inverse, wrong = np.linalg.inv(truth), truth.copy()
    if words.startswith("inverted (it"):
        return inverse
    if words.startswith("of camera axes"):
        return np.linalg.inv(OPTICAL_FROM_BODY) @ truth
    if words.startswith("inverted, and of"):
        return np.linalg.inv(np.linalg.inv(OPTICAL_FROM_BODY) @ truth)
    if words.startswith("the camera's position"):
        wrong[:3, 3] = inverse[:3, 3]
    if words.startswith("a transposed"):
        wrong[:3, :3] = truth[:3, :3].T
    if words.startswith("a translation in"):
        wrong[:3, 3] *= 1000
    if words.startswith("inverted, with"):
        inverse[:3, 3] *= 1000
        return inverse
    return wrong
