"""The page: everything of a result, nothing fetched, whatever is missing; its numbers are right."""

import html
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markupsafe import escape
from scipy.spatial.transform import Rotation

from calibgraph import Calibration, Check, Rig, Verdict
from calibgraph.model.lens import LensEstimate
from calibgraph.report.plots import reprojection_errors
from tests.chromium import render
from tests.conftest import CommandRun
from tests.report.conftest import read_page, solve_simulated, write_page


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
    assert "Error bar per axis: one standard deviation, about and along it" in text
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
    assert result.error_bar("left") is None and result.error_bar("right") is not None
    assert result.error_bar("left->right") is None and result.sigmas("left") is not None


def test_images_before_and_after_are_in_the_page(
    calibrated_sample: CommandRun, sample_result: Calibration
) -> None:
    text = read_page(calibrated_sample.folder / "report.html")
    assert text.count("data:image/jpeg") == 3 * 2
    assert "Overlays are left out" not in text
    for name in sample_result.rig.cameras:
        for when in ("before", "after"):
            assert f'alt="{name} {when}, coloured by distance"' in text
    matches = sample_result.camera_matches
    assert matches is not None
    for a, b in matches.pairs():
        row = text.split(f"<td>{a}, {b}</td>")[1].split("</tr>")[0]
        assert f">{len(matches.of_pair(a, b))}</td>" in row and f"pose of {a} to {b}" in row
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
    turned = replace(sample_result, initial_rig=guess)
    assert write_page(turned, tmp_path).count("data:image/jpeg") == 3 * 2


def test_errors_are_those_at_the_result(pair_without_outliers: Calibration) -> None:
    result = pair_without_outliers
    left = reprojection_errors(result)["left"]
    # The median of 1600 two-dimensional errors of 1 px per axis is 1.177 px, to some 2 percent.
    sizes_px, known = np.hypot(*left[:, 2:].T), result.residuals["left"]
    assert np.median(sizes_px) == pytest.approx(1.177, rel=0.1)
    assert np.median(sizes_px) == pytest.approx(known.median_px)
    assert abs(np.count_nonzero(sizes_px <= known.gate_px) - result.counts["left"]["used"]) < 10


def test_a_browser_shows_it_without_errors_and_without_a_network(
    browser: Any, calibrated_sample: CommandRun
) -> None:
    page = calibrated_sample.folder / "report.html"
    for width in (1280, 500):
        rendering = render(browser, page, width)
        assert rendering.errors == []
        assert rendering.requests == []
        assert rendering.picture.shape[1] == width
        green = (rendering.picture[:400, :60] == (0x3F, 0x61, 0)).all(axis=2)  # BGR: PASS
        assert green.sum() > 500
        assert rendering.picture[400:].std() > 20  # not blank: the overlays
