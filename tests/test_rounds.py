from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calibgraph
from calibgraph import Config, CorrespondenceError, perturb, rounds, simulate_correspondences
from calibgraph.model.geometry import pose_difference
from calibgraph.solver.joint import solve_joint, solve_without_failing
from tests.conftest import SAMPLE
from tests.matching.structure.data import with_noise_images


@pytest.mark.usefixtures("no_image_checks")
def test_a_camera_that_nothing_determines_fails_and_the_others_are_calibrated(
    tmp_path: Path,
) -> None:
    """The correspondences have none of the camera, and its images show noise."""
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    guess = perturb(truth, rotation_deg=2, translation_m=0.2, seed=1)
    data = with_noise_images(calibgraph.load_dataset(SAMPLE, guess), "left", tmp_path)
    table = simulate_correspondences(truth, frames=6)
    others = table.select(table.camera_index != table.cameras.index("left"))
    result = calibgraph.calibrate(data, guess, others)
    assert result.camera_verdicts["left"].status == "FAIL"
    reasons = " ".join(result.camera_verdicts["left"].reasons)
    assert "too few" in reasons and "it is left at its guess" in reasons
    assert result.sigmas("left") is None
    np.testing.assert_allclose(
        result.T_camera_lidar["left"], guess.T_camera_lidar["left"], atol=1e-6
    )
    errors = calibgraph.evaluate(result.rig, truth).cameras
    for name in ("front_left", "front_right"):
        assert errors[name].rotation_error_deg < 0.1, name
        assert errors[name].translation_error_cm < 2, name
        assert result.sigmas(name) is not None
    result.save(tmp_path / "out")
    assert calibgraph.load_calibration(tmp_path / "out").sigmas("left") is None


def test_a_camera_whose_matches_do_not_agree_is_held_and_the_others_are_solved() -> None:
    """Enough of them to begin with, and too few within the gate: it fails, not the whole rig."""
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    table = simulate_correspondences(truth, frames=3, matches=100)
    own = np.flatnonzero(table.camera_index == table.cameras.index("left"))
    pixels = table.pixels_px.copy()
    pixels[own[3:7]] += [[200, 0], [0, 150], [-180, 20], [30, -160]]
    other = np.flatnonzero(table.camera_index != table.cameras.index("left"))
    table = replace(table, pixels_px=pixels).select(np.sort(np.r_[own[:7], other]))
    with pytest.raises(CorrespondenceError, match="within the gate"):
        solve_joint(truth, table, Config())
    solution = solve_without_failing(truth, table, Config())
    assert solution.held == solution.config.excluded_cameras == ("left",)
    for name in ("front_left", "front_right"):
        T = solution.T_camera_lidar[name]
        assert pose_difference(T, truth.cameras[name].T_camera_lidar)[0] < 0.1


def test_a_lone_camera_without_enough_matches_was_perhaps_not_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Then that is the reason, and not the gate."""
    monkeypatch.setattr(rounds, "likely_intended_guess", lambda *_: None)
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    rig = calibgraph.Rig(cameras={"left": truth.cameras["left"]})
    data = calibgraph.load_dataset(SAMPLE, rig).select("0")
    few = simulate_correspondences(rig, frames=1, matches=5)
    for missed, reason in (({"left": 7.0}, "the search has not found this camera"), ({}, "")):
        table = few.with_metadata({**few.metadata, "missed": missed})
        with pytest.raises(CorrespondenceError, match=f"correspondences.*{reason}") as error:
            calibgraph.calibrate(data, rig, table)
        assert bool(missed) == ("not found" in str(error.value))
