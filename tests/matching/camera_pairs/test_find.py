"""Camera-camera matches of recordings: right where views overlap, none where they do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Camera, Dataset, Rig, simulate_street
from calibgraph.matching.camera_pairs import match_cameras, with_surfaces
from calibgraph.matching.camera_pairs.features import detect_features
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.camera_pairs import pair_terms
from calibgraph.solver.pair_refinement import fit_pair
from factors import pose_sigmas
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


def test_matching_is_repeatable(found: CameraMatches, data: Dataset, truth: Rig) -> None:
    again = match_cameras(data, truth)
    np.testing.assert_array_equal(found.pixels_px, again.pixels_px)


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


@pytest.mark.slow
@pytest.mark.usefixtures("open3d")
def test_fisheyes_a_right_angle_apart_have_matches(tmp_path: Path) -> None:
    """Of 190 degrees, to the front, the left and the back; nothing is in the first and the last."""
    rig = Rig(
        cameras={n: half_size(rig_of("fisheye").cameras[n]) for n in ("front", "left", "back")}
    )
    simulate_street(tmp_path / "street", rig, frames=2, seed=0)
    data = calibgraph.load_dataset(tmp_path / "street")
    matches = match_cameras(data, rig)
    assert matches.pairs() == [("front", "left"), ("left", "back")]
    # At the true poses, without any use of the LiDAR; features are good to 0.3 px.
    (front_left, _) = pair_terms(rig, matches, Config())
    assert np.median(front_left.errors_px(rig.T_camera_lidar)) < 0.6


def half_size(camera: Camera) -> Camera:
    k = camera.intrinsics_px
    center = {"cx": (k.cx + 0.5) / 2 - 0.5, "cy": (k.cy + 0.5) / 2 - 0.5}
    small = k.model_copy(update={"fx": k.fx / 2, "fy": k.fy / 2, **center})
    size = {"width_px": camera.width_px // 2, "height_px": camera.height_px // 2}
    return camera.model_copy(update={**size, "intrinsics_px": small})


@pytest.mark.realdata
def test_neighbours_of_a_surround_rig_have_matches_and_others_none(realdata: Path) -> None:
    data = calibgraph.load_dataset(realdata / "surround6")
    sure = {
        ("CAMERA_01", "CAMERA_05"), ("CAMERA_05", "CAMERA_07"), ("CAMERA_06", "CAMERA_08"),
        ("CAMERA_07", "CAMERA_09"), ("CAMERA_08", "CAMERA_09"),
    }  # fmt: skip
    found = set(match_cameras(data, data.rig).pairs())
    # Neighbours too, with 41 matches or none: OpenCV rounds otherwise on another processor.
    assert found - {("CAMERA_01", "CAMERA_06")} == sure


@pytest.mark.realdata
@pytest.mark.parametrize("sequence", ["07", "08"])
def test_kitti_pairs_are_found_from_a_displaced_first_camera(realdata: Path, sequence: str) -> None:
    """1.5 deg and 30 cm off; fixed points would leave 0.1 to 0.4 deg and 9 to 13 cm."""
    data = calibgraph.load_dataset(realdata / "kitti_odometry" / "sequences" / sequence)
    matches, reference = match_cameras(data, data.rig), data.rig
    rig = start = calibgraph.perturb(reference, rotation_deg=1.5, translation_m=0.3, seed=0)
    held = np.diag(pose_sigmas(rotation_rad=0.015, translation_m=0.17) ** 2)
    pair = ("image_2", "image_3")
    for _ in range(3):
        terms = pair_terms(rig, with_surfaces(matches, data, rig), Config())
        rig = start.moved_to(fit_pair(pair, terms, start.T_camera_lidar, held))
    error = calibgraph.evaluate(rig, reference).pairs["image_2->image_3"]
    assert error.rotation_error_deg < 0.08
    assert error.translation_error_cm < 4
