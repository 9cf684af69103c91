"""Camera-camera matches of recordings: right where views overlap, none where they do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Dataset, Rig
from calibgraph.matching.camera_pairs import match_cameras, with_surfaces
from calibgraph.matching.camera_pairs.features import detect_features, match_features
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config
from calibgraph.solver.camera_pairs import pair_terms
from tests.conftest import SAMPLE


@pytest.fixture(scope="module")
def data() -> Dataset:
    return calibgraph.load_dataset(SAMPLE).select("0:3")


@pytest.fixture(scope="module")
def truth() -> Rig:
    return calibgraph.load_rig(SAMPLE / "reference.yaml")


@pytest.fixture(scope="module")
def found(data: Dataset, truth: Rig) -> CameraMatches:
    return match_cameras(data, truth)


def test_only_cameras_that_overlap_have_matches(found: CameraMatches) -> None:
    assert found.pairs() == [("front_left", "front_right")]
    assert np.unique(found.frame).tolist() == [0, 1, 2]
    assert np.isnan(found.planes_lidar_per_m).all()


def test_matches_are_right_where_the_lidar_knows(
    found: CameraMatches, data: Dataset, truth: Rig
) -> None:
    """Predicted from either camera in the other, with the true rig.

    Features are good to 0.6 px per axis; about a tenth are wrong along their epipolar line.
    """
    terms = pair_terms(truth, with_surfaces(found, data, truth), Config())
    assert [(term.a, term.b) for term in terms[:2]] == [
        ("front_left", "front_right"), ("front_right", "front_left"),
    ]  # fmt: skip
    for term in terms[:2]:
        errors = term.errors_px(truth.T_camera_lidar)
        assert len(errors) > 50
        assert np.median(errors) < 1.0
        assert np.mean(errors < 4) > 0.85


def test_pairs_can_be_chosen(data: Dataset, truth: Rig) -> None:
    one = data.select("0")
    assert match_cameras(one, truth, pairs=[("front_right", "left")]).pairs() == []
    assert match_cameras(one, truth, pairs=[]).pairs() == []


def test_matching_is_repeatable(found: CameraMatches, data: Dataset, truth: Rig) -> None:
    again = match_cameras(data, truth)
    np.testing.assert_array_equal(found.pixels_px, again.pixels_px)


def test_images_without_texture_have_no_features(truth: Rig) -> None:
    camera = truth.cameras["front_left"]
    none = detect_features(np.full((360, 640), 90, np.uint8), camera)
    assert len(none.rays) == 0
    assert match_features(none, none).shape == (0, 2)


def test_features_have_no_bias(data: Dataset, truth: Rig) -> None:
    """A mirrored image has the mirrored features."""
    camera = truth.cameras["front_left"]
    gray = data.frames[0].load_gray("front_left", camera)
    flipped = np.ascontiguousarray(gray[:, ::-1])
    a, b = detect_features(gray, camera), detect_features(flipped, camera)
    mirrored = np.column_stack([gray.shape[1] - 1 - b.pixels_px[:, 0], b.pixels_px[:, 1]])
    distance = np.linalg.norm(a.pixels_px[:, None] - mirrored, axis=2)
    nearest = distance.argmin(axis=1)
    close = distance.min(axis=1) < 0.7
    assert close.mean() > 0.7
    shift = (a.pixels_px - mirrored[nearest])[close].mean(axis=0)
    assert np.abs(shift).max() < 0.02  # the default of OpenCV's SIFT has 0.5 here: twice 0.25


@pytest.mark.realdata
def test_neighbours_of_a_surround_rig_have_matches_and_others_none(realdata: Path) -> None:
    data = calibgraph.load_dataset(realdata / "surround6")
    assert match_cameras(data, data.rig).pairs() == [
        ("CAMERA_01", "CAMERA_05"), ("CAMERA_05", "CAMERA_07"), ("CAMERA_06", "CAMERA_08"),
        ("CAMERA_07", "CAMERA_09"), ("CAMERA_08", "CAMERA_09"),
    ]  # fmt: skip
