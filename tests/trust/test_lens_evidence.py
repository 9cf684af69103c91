"""The lens that fits the images best: found where it is wrong, and left alone where it is not."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import calibgraph
from calibgraph import Camera, Rig
from calibgraph.model.places import Places
from calibgraph.solver.columns import apply_twist
from calibgraph.trust.image_evidence import WIDE, measure_lens
from calibgraph.trust.lens_parameter import (
    IMAGES,
    NAMES,
    Free,
    LensParameter,
    check_parameter,
    lens_variable,
)
from calibgraph.trust.pose_posterior import FrameScorer
from tests.conftest import SAMPLE

NAME = "front_left"


FOCAL, RADIAL, CENTRE_X, _, ASPECT = Free
CALIBRATED = 0.002  # one standard deviation of a calibrated lens


def change_lens(camera: Camera, number: int, error: float) -> Camera:
    """The camera with one parameter of its lens changed; the principal point in focal lengths."""
    values = np.zeros(5)
    values[number] = error / CALIBRATED
    return lens_variable(camera).put_into(camera, values)


@pytest.fixture(scope="module")
def truth() -> Camera:
    return calibgraph.load_rig(SAMPLE / "reference.yaml").cameras[NAME]


def measure(camera: Camera) -> tuple[LensParameter, ...]:
    dataset = calibgraph.load_dataset(SAMPLE, Rig(cameras={NAME: camera}))
    with ThreadPoolExecutor(2) as pool:
        scorer = FrameScorer(dataset, dataset.frames, pool)
        scores = scorer.score_together(NAME, camera, WIDE)
        return measure_lens(scorer, NAME, camera, scores, seed=0, places=Places(stationary=((0,),)))


@pytest.mark.parametrize(
    ("number", "error", "name"),
    [
        (FOCAL, 0.03, "focal length"),
        (RADIAL, -0.1, "distortion"),
        pytest.param(CENTRE_X, 0.04, "principal point", marks=pytest.mark.slow),
        pytest.param(ASPECT, 0.06, "aspect ratio", marks=pytest.mark.slow),
    ],
)
def test_a_wrong_lens_is_named_and_measured(
    truth: Camera, *, number: int, error: float, name: str
) -> None:
    # A rotation about the y axis compensates for the principal point, as in a calibration.
    turn = -error if number == CENTRE_X else 0.0
    wrong = change_lens(truth, number, error)
    found = measure(apply_twist(wrong, np.array([0.0, turn, 0.0, 0.0, 0.0, 0.0])))
    (value,) = CALIBRATED * found[[*NAMES].index(name)].values
    assert value == pytest.approx(-error, abs=0.2 * abs(error) + 0.004)
    status = {each.name: check_parameter(each, IMAGES).status for each in found}
    assert status[name] != "PASS"
    if name == "aspect ratio":  # half of it is a focal length
        return
    assert all(status[other] == "PASS" for other in NAMES if other != name)
