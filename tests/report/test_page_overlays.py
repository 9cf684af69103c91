"""The pictures of points on images, before and after."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibgraph import Calibration
from tests.conftest import CommandRun
from tests.report.conftest import read_page, write_page

pytestmark = pytest.mark.usefixtures("blank_diagrams")


def test_images_before_and_after_are_in_the_page(
    calibrated_sample: CommandRun, sample_result: Calibration
) -> None:
    text = read_page(calibrated_sample.folder / "report.html")
    assert text.count("data:image/jpeg") == 3 * 4 + 1  # and one pair of cameras
    assert "Overlays are left out" not in text
    for name in sample_result.rig.cameras:
        for when in ("before", "after"):
            assert f'alt="{name} {when}, coloured by residual"' in text
    for key in sample_result.config.model_dump():
        assert key in text
    for path, digest in sample_result.inputs.items():
        assert f"{digest}  {path}" in text
    assert sample_result.versions["numpy"] in text


def test_missing_images_are_one_line_and_the_rest_is_there(
    sample_result: Calibration, tmp_path: Path
) -> None:
    gone = tuple(
        {**frame, "cloud": "/nowhere/a.bin", "images": dict.fromkeys(frame["images"], "/nowhere")}
        for frame in sample_result.frames
    )
    text = write_page(replace(sample_result, frames=gone), tmp_path)
    assert "<b>Overlays are left out:</b> /nowhere/a.bin: no such file; check the path." in text
    assert "data:image/jpeg" not in text
    assert "Residuals over the image of left" in text


def test_a_guess_that_projects_no_point_is_drawn(
    sample_result: Calibration, tmp_path: Path
) -> None:
    flip = np.diag([-1.0, 1.0, -1.0, 1.0])
    backwards = {name: flip @ T for name, T in sample_result.initial_rig.T_camera_lidar.items()}
    guess = sample_result.initial_rig.moved_to(backwards)
    # With several rounds, the last began near the result, so that there are matches to draw.
    turned = replace(sample_result, initial_rig=guess, rounds=2 * sample_result.rounds)
    assert write_page(turned, tmp_path).count("data:image/jpeg") == 3 * 4 + 1
