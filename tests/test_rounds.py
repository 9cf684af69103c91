from __future__ import annotations

from pathlib import Path

import numpy as np

import calibgraph
from calibgraph import perturb, simulate_correspondences
from tests.conftest import SAMPLE
from tests.matching.structure.data import with_noise_images


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
    assert "it is left at its guess" in " ".join(result.camera_verdicts["left"].reasons)
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
