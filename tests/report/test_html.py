"""The page: everything of a result, nothing fetched, whatever is missing."""

from __future__ import annotations

import html
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import escape
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Calibration, Check, Rig, Verdict, simulate_correspondences
from calibgraph.model.lens_estimate import LensEstimate
from tests.conftest import ROOT, stereo_relative_pose
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


def test_the_order_is_verdict_action_picture_deployment_checks(
    sample_result: Calibration, tmp_path: Path
) -> None:
    text = write_page(sample_result, tmp_path)
    places = [text.index(part) for part in (
        "Can this calibration of 3 cameras", '<section class="verdict ', "What to do",
        "front_left before", "calibgraph export . ", "T_camera_lidar of front_left", " checks: ",
    )]  # fmt: skip
    assert places == sorted(places)


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


def test_a_camera_that_failed_is_left_out_of_the_export(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    failed = Verdict((Check("search", "FAIL", "not found"),))
    result = replace(solved_pair, camera_verdicts={**solved_pair.camera_verdicts, "left": failed})
    text = write_page(result, tmp_path)
    assert "--out rig.launch.xml --camera right</pre>" in text
    assert text.count("not to be deployed") == 1


def test_warnings_about_the_data_are_in_the_verdict(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    text = write_page(replace(solved_pair, warnings=("left: blurred <&>",)), tmp_path)
    assert "left: blurred &lt;&amp;&gt;" in text.split("</section>")[0]


def test_a_new_lens_and_the_old_one_are_in_the_verdict(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    focal = LensEstimate("focal", "px", 717.66, 2.13, 718.86, 14.4, "z", 0.4)
    late = LensEstimate("offset", "s", 0.0203, 0.0028, 0.0, 0.05, "z", 0.4)
    text = write_page(replace(solved_pair, lens={"left": (focal, late)}), tmp_path)
    line = "left: focal 717.7 +- 2.1 px, before 718.9 px; offset 20.3 +- 2.8 ms, before 0.0 ms."
    assert line in text.split("</section>")[0]


def test_the_title_names_the_recording_and_the_date(
    sample_result: Calibration, tmp_path: Path
) -> None:
    plain = replace(sample_result, date="2026-03-01", correspondences=None)
    title = title_of(write_page(plain, tmp_path))
    status = sample_result.verdict.status
    assert title.startswith(f"{status} - data/sample - 2026-03-01 - calibration of front_left")


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


def test_a_missing_error_bar_is_reported(pair: Rig, tmp_path: Path) -> None:
    result = solve_simulated(pair, terms="priors")
    assert result.covariance["left"] is None
    text = write_page(result, tmp_path)
    assert "Unknown: the correspondences do not determine them." in text
    assert "Error bar per axis: unknown, not by these correspondences" in text
    assert "One standard deviation, about and along" not in text


def test_weaknesses_priors_and_the_bootstrap_are_shown(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    bootstrap = np.diag(np.square([np.radians(0.123), *5 * [0.01]]))
    result = replace(
        solved_pair,
        weaknesses={"left": ("the height is loose <&>",)},
        prior_share={"left": 0.25},
        bootstrap={"left": bootstrap},
    )
    text = write_page(result, tmp_path)
    assert "<b>left</b>: the height is loose &lt;&amp;&gt;" in text
    assert "25 % of this camera" in text
    assert "0.123 deg" in text


def test_a_camera_without_correspondences_is_reported(pair: Rig, tmp_path: Path) -> None:
    rig = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    table = simulate_correspondences(pair, frames=8, matches=200)
    left = table.select(table.camera_index == table.cameras.index("left"))
    text = write_page(replace(calibgraph.solve(rig, left), correspondences=left), tmp_path)
    assert "Residuals over the image of left" in text
    assert "Residuals over the image of right" not in text


def test_a_result_without_correspondences_is_reported(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    text = write_page(replace(solved_pair, correspondences=None), tmp_path)
    assert "Pictures of the residuals are left out" in text
    assert "a point 10 m ahead on the optical axis" in text


def test_a_result_from_driving_is_reported(pair: Rig, tmp_path: Path) -> None:
    tracker = calibgraph.IncrementalCalibrator(pair)
    table = simulate_correspondences(pair, frames=12, matches=100)
    for frame in range(12):
        tracker.update(table.select(table.frame == frame))
    text = write_page(tracker.calibration(), tmp_path)
    assert "Pictures of the residuals are left out" in text
    assert "frames that wait" in text


def test_the_template_is_part_of_the_package() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert "calibgraph*" in setuptools["packages"]["find"]["include"]
    assert setuptools["package-data"]["calibgraph.report"] == ["*.html.j2", "static/*"]


def test_of_a_rig_that_fails_the_page_names_the_cameras_that_cannot_be_used(
    solved_pair: Calibration, tmp_path: Path
) -> None:
    """The export command beside it offers the other ones."""
    gone = Verdict((Check("search", "FAIL", "not found"),))
    verdicts = {**solved_pair.camera_verdicts, "left": gone}
    text = write_page(replace(solved_pair, camera_verdicts=verdicts), tmp_path)
    assert "Do not use left. Use right" in text
    assert "--camera right" in text
