"""The page: everything of a result, nothing fetched, whatever is missing."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape
from scipy.spatial.transform import Rotation

from calibgraph import Calibration, Check, Rig, Verdict
from calibgraph.model.lens_estimate import LensEstimate
from tests.report.conftest import solve_simulated, write_page

pytestmark = pytest.mark.usefixtures("blank_diagrams")


def title_of(text: str) -> str:
    match = re.search("<title>(.*?)</title>", text)
    assert match is not None
    return match[1]


def test_a_solved_table_is_reported_without_overlays(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    status = solved_pair.verdict.status
    text = write_page(solved_pair, tmp_path)
    assert title_of(text).startswith(status)
    assert f'<strong class="big">{status}</strong>' in text
    assert text.count("Overlays are left out:") == 1
    assert "Pictures of the residuals are left out" not in text
    assert "One standard deviation, about and along" in text
    for name in solved_pair.rig.cameras:
        assert f"Residuals over the image of {name}" in text
    for check in solved_pair.camera_verdicts["left"].checks:
        assert html.escape(check.name).replace("&#x27;", "&#39;") in text
    assert "one round only" in text


def test_a_failure_is_marked_prominently(pair: Rig, tmp_path: Path) -> None:
    result = solve_simulated(pair, outlier_share=1.0)
    assert result.verdict.status == "FAIL"
    text = write_page(result, tmp_path)
    assert title_of(text).startswith("FAIL - do not use")
    assert "No. Do not use it" in text
    assert 'class="verdict FAIL"' in text
    for reason in (*result.summary.reasons, *result.summary.others):
        assert str(escape(reason.text)) in text
    for action in result.summary.actions:
        assert str(escape(action)) in text
    assert text.count("not to be deployed") == 2 and "calibgraph export" not in text


def test_what_is_deployed_is_what_was_saved(solved_pair: Calibration, tmp_path: Path) -> None:
    text = write_page(solved_pair, tmp_path)
    for name, T in solved_pair.T_camera_lidar.items():
        block = text.split(f'aria-label="T_camera_lidar of {name}">')[1]
        shown = np.array(block.split("</pre>")[0].split(), np.float64).reshape(4, 4)
        np.testing.assert_allclose(shown, T, atol=5e-7)  # six decimals
        block = text.split(f'aria-label="translation and quaternion of {name}">')[1]
        numbers = [float(word) for word in re.findall(r"-?\d+\.\d+", block.split("</pre>")[0])]
        np.testing.assert_allclose(numbers[:3], T[:3, 3], atol=5e-7)
        rotation = Rotation.from_quat(numbers[3:]).as_matrix()
        np.testing.assert_allclose(rotation, T[:3, :3], atol=4e-6)  # of four rounded numbers


def test_a_new_lens_and_the_old_one_are_in_the_verdict(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    focal = LensEstimate("focal", "px", 717.66, 2.13, 718.86, 14.4, "z", 0.4)
    late = LensEstimate("offset", "s", 0.0203, 0.0028, 0.0, 0.05, "z", 0.4)
    text = write_page(replace(solved_pair, lens={"left": (focal, late)}), tmp_path)
    line = "left: focal 717.7 +- 2.1 px, before 718.9 px; offset 20.3 +- 2.8 ms, before 0.0 ms."
    assert line in text.split("</section>")[0]


def test_a_camera_that_failed_has_no_error_bar(solved_pair: Calibration, tmp_path: Path) -> None:
    failed = Verdict((Check("search", "FAIL", "not found"),))
    result = replace(solved_pair, camera_verdicts={**solved_pair.camera_verdicts, "left": failed})
    text = write_page(result, tmp_path)
    assert "Unknown for left: a FAIL has no error bar." in text
    assert "Least certain: right, " in text
    assert "Error bar per axis: unknown, since the verdict is FAIL" in text
    assert "unknown: the verdict of a camera is FAIL" in text  # of left->right
    assert text.count('alt="Error bars of ') == 1
    assert result.error_bar("left") is None and result.error_bar("right") is not None
    assert result.error_bar("left->right") is None and result.sigmas("left") is not None
