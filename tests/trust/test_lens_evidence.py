"""The lens that fits the images best: found where it is wrong, and left alone where it is not."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Camera, Dataset, Rig
from calibgraph.model.places import Places
from calibgraph.solver.camera_twist import apply_twist, project_with_jacobian
from calibgraph.trust.frame_scores import WIDE, FrameScorer
from calibgraph.trust.image_checks import evidence_checks
from calibgraph.trust.image_evidence import ImageEvidence
from calibgraph.trust.lens_evidence import (
    NAMES,
    LensEvidence,
    change_lens,
    lens_jacobian_px,
    measure_lens,
)
from tests.conftest import KANNALA, RADTAN5, SAMPLE, make_camera, points_in_front

NAME = "front_left"


@pytest.fixture(scope="module")
def truth() -> Camera:
    return calibgraph.load_rig(SAMPLE / "reference.yaml").cameras[NAME]


def measure(
    camera: Camera, dataset: Dataset | None = None, stop: tuple[int, ...] = (0,)
) -> LensEvidence:
    dataset = dataset or calibgraph.load_dataset(SAMPLE, Rig(cameras={NAME: camera}))
    with ThreadPoolExecutor(2) as pool:
        scorer = FrameScorer(dataset, dataset.frames, pool)
        images = scorer.load_images(NAME, camera)
        scores = scorer.score_together(images, camera, WIDE)
        return measure_lens(
            scorer, images, camera, scores, seed=0, places=Places(stationary=(stop,))
        )


def statuses(lens: LensEvidence) -> dict[str, str]:
    """Of the checks of the lens, of a calibrated pose: the true one of another lens fits less."""
    found = ImageEvidence(
        groups=100,
        lens=lens.parameters,
        gain=lens.gain,
        displaced_z_score=5.0,
        frames_best=1.0,
    )
    checks = {check.kind: check.status for check in evidence_checks(found, {})}
    return {name: checks[name.replace(" ", "_")] for name in NAMES}


@pytest.mark.parametrize(
    ("index", "error", "name"),
    [
        (0, 0.03, "focal length"),
        (1, -0.1, "distortion"),
        (2, 0.04, "principal point"),
        (3, 0.04, "aspect ratio"),
    ],
)
def test_a_wrong_lens_is_named_and_measured(
    truth: Camera, *, index: int, error: float, name: str
) -> None:
    change = np.zeros(4)
    change[index] = error
    # A rotation about the y axis compensates for the principal point, as in a calibration.
    compensation = np.array([0.0, -change[2], 0.0, 0.0, 0.0, 0.0])
    found = measure(apply_twist(change_lens(truth, change), compensation))
    assert found.parameters[index].values[0] == pytest.approx(-error, abs=0.2 * abs(error) + 0.004)
    status = statuses(found)
    assert status[name] != "PASS"
    if name == "aspect ratio":  # half of it is a focal length
        return
    assert all(status[other] == "PASS" for other in NAMES if other != name)


def test_frames_of_one_content_are_one_frame_which_shows_no_significance(truth: Camera) -> None:
    camera = change_lens(truth, np.array([0.03, 0.0, 0.0, 0.0]))
    found, apart = measure(camera, stop=tuple(range(6))), measure(camera)
    assert found.gain == pytest.approx(apart.gain / math.sqrt(6))
    assert all(math.isnan(each.sigma) and each.probability == 0.0 for each in found.parameters)
    assert abs(found.parameters[0].values[0]) > 0.01  # noqa: PLR2004


@pytest.mark.parametrize("skew", [pytest.param(-0.03, marks=pytest.mark.slow), 0.03])
def test_sheared_images_are_named_and_measured(truth: Camera, tmp_path: Path, skew: float) -> None:
    k = truth.intrinsics_px
    lean = skew * k.fx / k.fy
    shear = np.array([[1.0, lean, -lean * k.cy], [0.0, 1.0, 0.0]])
    # As in a calibration: half of a skew is a rotation.
    turned = apply_twist(truth, np.array([0.0, 0.0, skew / 2, 0.0, 0.0, 0.0]))
    dataset = calibgraph.load_dataset(SAMPLE, Rig(cameras={NAME: turned}))
    frames = []
    for frame in dataset.frames:
        image = frame.load_image(NAME, truth)
        path = tmp_path / f"{frame.index}.png"
        cv2.imwrite(str(path), cv2.warpAffine(image, shear, image.shape[1::-1]))
        frames.append(replace(frame, image_paths={NAME: path}))
    found = measure(turned, replace(dataset, frames=tuple(frames)))
    assert found.parameters[4].values[0] == pytest.approx(skew, abs=0.007)
    status = statuses(found)
    assert status["skew"] != "PASS"
    assert status["distortion"] == status["principal point"] == "PASS"


@pytest.mark.parametrize(
    "camera",
    [
        make_camera(),
        make_camera(distortion=RADTAN5),
        make_camera(model="fisheye", distortion=KANNALA),
    ],
)
def test_the_jacobian_of_the_lens_is_its_derivative(camera: Camera) -> None:
    points = points_in_front(np.random.default_rng(0), 200)
    jacobian = lens_jacobian_px(camera, points)
    step = 1e-6
    for index in (0, 2, 3):  # the radial column is that of an undistorted pinhole
        change = np.zeros(4)
        change[index] = step
        plus, minus = change_lens(camera, change), change_lens(camera, -change)
        difference = (
            project_with_jacobian(plus, points)[0] - project_with_jacobian(minus, points)[0]
        )
        np.testing.assert_allclose(difference / (2 * step), jacobian[:, :, index], atol=1e-3)


def test_a_skew_moves_a_pixel_by_its_height_less_a_rotation() -> None:
    camera = make_camera()
    k = camera.intrinsics_px
    points = points_in_front(np.random.default_rng(0), 200)
    off = project_with_jacobian(camera, points)[0] - [k.cx, k.cy]
    sheared = np.column_stack([off[:, 1] * k.fx / k.fy, np.zeros(len(off))])
    x, y = off[:, 0] / k.fx, off[:, 1] / k.fy
    turned = np.column_stack([k.fx * y, -k.fy * x])
    expected = sheared - 0.5 * turned
    np.testing.assert_allclose(lens_jacobian_px(camera, points)[:, :, 4], expected, atol=1e-9)
