"""The lens that fits the images best: found where it is wrong, and left alone where it is not."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import gtsam
import numpy as np
import pytest

import calibgraph
from calibgraph import Camera, Dataset, Rig
from calibgraph.io.frame import Frame
from calibgraph.model.places import Places
from calibgraph.solver.columns import apply_twist
from calibgraph.trust import image_evidence
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


def measure(
    camera: Camera, dataset: Dataset | None = None, stop: tuple[int, ...] = (0,)
) -> tuple[LensParameter, ...]:
    dataset = dataset or calibgraph.load_dataset(SAMPLE, Rig(cameras={NAME: camera}))
    with ThreadPoolExecutor(2) as pool:
        scorer = FrameScorer(dataset, dataset.frames, pool)
        scores = scorer.score_together(NAME, camera, WIDE)
        return measure_lens(scorer, NAME, camera, scores, seed=0, places=Places(stationary=(stop,)))


@pytest.mark.parametrize(
    ("number", "error", "name"),
    [
        (FOCAL, 0.03, "focal length"),
        (RADIAL, -0.1, "distortion"),
        (CENTRE_X, 0.04, "principal point"),
        (ASPECT, 0.06, "aspect ratio"),
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


class _Seen(Exception):
    """Ends a measurement with the points that the lens is applied to."""


def test_the_lens_is_applied_to_points_where_they_are_when_they_are_seen(
    truth: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    def see(points_m: np.ndarray, *_: object) -> np.ndarray:
        raise _Seen(points_m)

    monkeypatch.setattr(image_evidence, "fields_px", see)
    late = truth.model_copy(update={"time_offset_s": 0.05})
    data, twist = calibgraph.load_dataset(SAMPLE, Rig(cameras={NAME: late})), np.arange(6.0)
    files = [(f.index, f.name, f.cloud_path, f.image_paths) for f in data.frames[:2]]
    moving = tuple(Frame(*each, find_twist=lambda: twist) for each in files)
    with ThreadPoolExecutor(2) as pool:
        scorer = FrameScorer(replace(data, frames=moving), moving, pool)
        scores = scorer.score_together(NAME, late, WIDE)
        with pytest.raises(_Seen) as seen:
            measure_lens(scorer, NAME, late, scores, seed=0)
    step = gtsam.Pose3.Expmap(-0.05 * twist).matrix()
    expected = scores.points_lidar_m @ step[:3, :3].T + step[:3, 3]
    np.testing.assert_allclose(seen.value.args[0], expected, atol=1e-9)
