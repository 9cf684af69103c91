"""The report: one page that says everything, needs nothing else, and opens in a browser."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

import calibgraph
from calibgraph import Calibration, MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.errors import DatasetError
from calibgraph.report import with_files_of, write_report
from calibgraph.report.frame_errors import _constrained, errors_of
from calibgraph.report.plots import _arrow_factor, _cell_means
from calibgraph.report.worked_point import worked_point
from calibgraph.solver.whitening import constrained_error_px
from tests.conftest import ROOT, SAMPLE, Call, make_camera, stereo_relative_pose

MOST_BYTES = 6_000_000
NASTY = "<b>x&\"y'</b>"


def solved(rig: Rig, *, frames: int = 8, outlier_share: float = 0.15) -> Calibration:
    """A result of a simulated table, from 2 degrees and 0.2 m off."""
    errors = MatcherErrors(noise_px=1.0, outlier_share=outlier_share)
    table = simulate_correspondences(rig, frames=frames, matches=200, errors=errors)
    guess = perturb(rig, rotation_deg=2, translation_m=0.2)
    return replace(calibgraph.solve(guess, table), correspondences=table)


@pytest.fixture(scope="module")
def of_sample() -> Calibration:
    """The sample, its images and clouds, with matches that are the truth and a pixel of noise."""
    truth = calibgraph.load_rig(SAMPLE / "reference.yaml")
    table = simulate_correspondences(truth, frames=6, errors=MatcherErrors(outlier_share=0.1))
    return calibgraph.calibrate(SAMPLE, matcher=table)


def page_of(result: Calibration, folder: Path) -> str:
    text = write_report(result, folder / "report.html").read_text("utf-8")
    assert len(text) < MOST_BYTES
    assert "http://" not in text and "https://" not in text
    assert set(re.findall(r'src="([^,"]*)', text)) <= {
        "data:image/png;base64", "data:image/jpeg;base64",
    }  # fmt: skip
    assert set(re.findall(r'href="([^"]{0,6})', text)) <= {"data:,", "#camer"}
    assert "url(" not in text and "@import" not in text
    return text


def title_of(text: str) -> str:
    found = re.search("<title>(.*?)</title>", text)
    assert found is not None
    return found[1]


def test_a_solved_table_is_reported_without_overlays(pair: Rig, tmp_path: Path) -> None:
    result = solved(pair)
    text = page_of(result, tmp_path)
    assert title_of(text).startswith(result.verdict.status)
    assert f'<strong class="big">{result.verdict.status}</strong>' in text
    assert text.count("Overlays are left out:") == 1
    assert "Pictures of the residuals are left out" not in text
    assert "One standard deviation, about and along" in text
    for name in pair.cameras:
        assert f"Residuals over the image of {name}" in text
    for check in result.camera_verdicts["left"].checks:
        assert html.escape(check.name).replace("&#x27;", "&#39;") in text
    assert "one round only" in text


def test_names_are_the_users_and_are_escaped(tmp_path: Path) -> None:
    rig = Rig(cameras={NASTY.replace("/", ""): make_camera(), "$x_1$": make_camera((0, 0.5, 0))})
    text = page_of(solved(rig), tmp_path)
    assert "<b>x" not in text
    assert "&lt;b&gt;x&amp;&#34;y&#39;&lt;b&gt;" in text
    assert "$x_1$" in text


def test_a_failure_is_marked_loudly(pair: Rig, tmp_path: Path) -> None:
    result = solved(pair, outlier_share=1.0)
    assert result.verdict.status == "FAIL"
    text = page_of(result, tmp_path)
    assert title_of(text).startswith("FAIL - do not use")
    assert "No. Do not use this result" in text
    assert 'class="verdict FAIL"' in text
    for reason in result.camera_verdicts["left"].reasons:
        assert reason.split(":")[0] in text


def test_few_frames_have_no_error_bar_and_the_page_says_so(pair: Rig, tmp_path: Path) -> None:
    result = solved(pair, frames=3)
    assert result.covariance["left"] is None
    text = page_of(result, tmp_path)
    assert "Too few frames to say." in text
    assert "too few frames to say" in text
    assert "One standard deviation, about and along" not in text


def test_weaknesses_priors_and_the_bootstrap_are_shown(pair: Rig, tmp_path: Path) -> None:
    bootstrap = np.diag(np.square([np.radians(0.123), *5 * [0.01]]))
    result = replace(
        solved(pair),
        weaknesses={"left": ("the height is loose <&>",)},
        prior_share={"left": 0.25},
        bootstrap={"left": bootstrap},
    )
    text = page_of(result, tmp_path)
    assert "<b>left</b>: the height is loose &lt;&amp;&gt;" in text
    assert "25 % of this camera" in text
    assert "0.123 deg" in text


def test_a_camera_known_through_others_only_is_reported(pair: Rig, tmp_path: Path) -> None:
    rig = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    table = simulate_correspondences(pair, frames=8, matches=200)
    left = table.select(table.camera_index == table.cameras.index("left"))
    text = page_of(replace(calibgraph.solve(rig, left), correspondences=left), tmp_path)
    assert "Residuals over the image of left" in text
    assert "Residuals over the image of right" not in text


def test_a_result_without_correspondences_is_reported(pair: Rig, tmp_path: Path) -> None:
    text = page_of(replace(solved(pair), correspondences=None), tmp_path)
    assert "Pictures of the residuals are left out" in text
    assert "a point 10 m ahead on the optical axis" in text


def test_a_result_from_driving_is_reported(pair: Rig, tmp_path: Path) -> None:
    tracker = calibgraph.IncrementalCalibrator(pair)
    table = simulate_correspondences(pair, frames=12, matches=100)
    for frame in range(12):
        tracker.update(table.select(table.frame == frame))
    text = page_of(tracker.calibration(), tmp_path)
    assert "Pictures of the residuals are left out" in text
    assert "frames that wait" in text


def test_images_before_and_after_are_in_the_page(of_sample: Calibration, tmp_path: Path) -> None:
    text = page_of(of_sample, tmp_path)
    assert text.count("data:image/jpeg") == 3 * 4
    assert "Overlays are left out" not in text
    for name in of_sample.rig.cameras:
        for when in ("before", "after"):
            assert f'alt="{name} {when}, coloured by residual"' in text
    for key in of_sample.config.model_dump():
        assert key in text
    for path, digest in of_sample.inputs.items():
        assert f"{digest}  {path}" in text
    assert of_sample.versions["numpy"] in text


def test_missing_images_are_one_line_and_the_rest_is_there(
    of_sample: Calibration, tmp_path: Path
) -> None:
    gone = tuple({**frame, "cloud": "/nowhere/a.bin"} for frame in of_sample.frames)
    text = page_of(replace(of_sample, frames=gone), tmp_path)
    assert "<b>Overlays are left out:</b> /nowhere/a.bin: no such file; check the path." in text
    assert "data:image/jpeg" not in text
    assert "Residuals over the image of left" in text


def test_a_dataset_that_has_moved_is_found(of_sample: Calibration, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(SAMPLE, tmp_path / "moved"))
    dataset = calibgraph.load_dataset(moved)
    found = with_files_of(of_sample, dataset)
    assert [frame["name"] for frame in found.frames] == [f["name"] for f in of_sample.frames]
    assert all(frame["cloud"].startswith(str(moved)) for frame in found.frames)
    assert with_files_of(replace(of_sample, frames=()), dataset).frames == found.frames
    with pytest.raises(DatasetError, match="has no frame number 3 named '000003'"):
        with_files_of(of_sample, dataset.select("0:3"))


def test_a_guess_that_sees_nothing_of_the_cloud_is_drawn(
    of_sample: Calibration, tmp_path: Path
) -> None:
    flip = np.diag([-1.0, 1.0, -1.0, 1.0])
    backwards = {name: flip @ T for name, T in of_sample.initial_rig.T_camera_lidar.items()}
    guess = of_sample.initial_rig.moved_to(backwards)
    # With several rounds, the last began near the result, so that there are matches to draw.
    turned = replace(of_sample, initial_rig=guess, rounds=2 * of_sample.rounds)
    assert page_of(turned, tmp_path).count("data:image/jpeg") == 3 * 4


def test_vectors_of_edges_are_as_long_as_the_gate_sees_them() -> None:
    rng = np.random.default_rng(0)
    residuals, normals = rng.normal(0, 3, (2, 50, 2))
    edges = np.column_stack(
        [normals[:, 0] ** 2, normals[:, 0] * normals[:, 1], normals[:, 1] ** 2]
    ) + np.outer(rng.integers(0, 2, 50), [0.5, 0.1, 0.7])
    lengths = np.hypot(*_constrained(residuals, edges).T)
    np.testing.assert_allclose(lengths, constrained_error_px(residuals, edges), atol=1e-9)
    np.testing.assert_array_equal(_constrained(residuals, None), residuals)


def test_errors_before_and_after_are_those_of_the_poses(pair: Rig) -> None:
    result = solved(pair, outlier_share=0.0)
    left = errors_of(result)["left"]
    # The median of 1600 two-dimensional errors of 1 px per axis is 1.177 px, to some 2 percent.
    assert np.median(left.after.sizes_px) == pytest.approx(1.177, rel=0.1)
    assert np.median(left.before.sizes_px) > 10 * np.median(left.after.sizes_px)
    assert np.median(left.after.sizes_px) == pytest.approx(result.residuals["left"].median_px)
    assert abs(np.count_nonzero(left.after.inside) - result.counts["left"]["used"]) < 10


def test_arrows_are_the_mean_of_their_cell(pair: Rig) -> None:
    after = errors_of(solved(pair))["left"].after
    shifted = replace(after, vectors_px=np.tile([0.5, -0.25], (len(after.frame), 1)))
    _, means, cell_px = _cell_means(pair.cameras["left"], shifted)
    np.testing.assert_allclose(means, np.tile([0.5, -0.25], (len(means), 1)))
    assert 0.3 * cell_px < _arrow_factor(means, cell_px) * np.hypot(0.5, 0.25) <= 0.9 * cell_px


def test_the_worked_point_is_right(pair: Rig) -> None:
    result = solved(pair, outlier_share=0.0)
    camera = result.rig.cameras["left"]
    worked = worked_point(camera, errors_of(result)["left"].after)
    numbers = {
        line.split("=")[0].strip(): [float(n) for n in re.findall(r"-?\d+\.\d+", line)]
        for line in worked.steps.splitlines()
    }
    T = camera.T_camera_lidar
    seen = T[:3, :3] @ numbers["p_lidar"] + T[:3, 3]
    np.testing.assert_allclose(numbers["p_camera"], seen, atol=2e-3)  # 3 digits
    fx, x, z, cx = numbers["u"]
    u, v = numbers["projected pixel (u, v)"]
    # x and z have three digits, at about 10 m: half a millimetre is 0.04 px.
    assert u == pytest.approx(fx * x / z + cx, abs=0.1)
    matched_u, matched_v, size = numbers["matched pixel"]
    assert np.hypot(u - matched_u, v - matched_v) == pytest.approx(size, abs=0.02)
    shown = np.array([line.split() for line in worked.matrix.splitlines()], dtype=float)
    np.testing.assert_allclose(shown, T, atol=1e-6)
    inverse = [float(n) for n in re.findall(r"-?\d+\.\d+", worked.inverse)]
    np.testing.assert_allclose(inverse[:3], np.linalg.inv(T)[:3, 3], atol=1e-6)


def test_the_command_writes_the_page_and_prints_the_verdict(
    pair: Rig, call: Call, tmp_path: Path
) -> None:
    pair.save(tmp_path / "rig.yaml")
    nonsense = MatcherErrors(outlier_share=1.0)
    simulate_correspondences(pair, errors=nonsense).save(tmp_path / "table.parquet")
    out = tmp_path / "out"
    code, _, err = call("solve", tmp_path / "rig.yaml", tmp_path / "table.parquet", "--out", out)
    assert code == 1
    assert str(out / "report.html") in err.replace("\n", "")
    page = (out / "report.html").read_text()
    (out / "report.html").unlink()
    code, _, err = call("report", out)
    assert code == 0
    assert "the verdict is FAIL" in err
    assert (out / "report.html").read_text() == page  # the file holds all that the page says
    code, _, _ = call("report", out / "calibration.yaml", "--out", tmp_path / "other.html")
    assert code == 0
    assert (tmp_path / "other.html").read_text() == page


def edited(result: Calibration, folder: Path) -> Path:
    """A result whose file somebody changed: what the folder is called."""
    path = result.save(folder)
    content = yaml.safe_load(path.read_text())
    if folder.name == "verdict":
        content["verdict"]["status"] = "FAIL" if result.verdict.status == "PASS" else "PASS"
    else:
        content["counts"] = None
    path.write_text(yaml.safe_dump(content))
    return folder


def test_what_cannot_be_reported_is_one_line(
    pair: Rig, of_sample: Calibration, call: Call, tmp_path: Path
) -> None:
    of_sample.save(tmp_path / "sample")
    strange = Path(shutil.copytree(tmp_path / "sample", tmp_path / "strange"))
    simulate_correspondences(pair, frames=1).save(strange / "correspondences.parquet")
    cases: dict[str, tuple[object, ...]] = {
        "no such file": (tmp_path / "nothing",),
        "calibration.yaml: no such file": (SAMPLE,),
        "no such folder": (tmp_path / "sample", "--dataset", tmp_path / "nothing"),
        "is not in the rig": (strange,),
        "it was edited": (edited(of_sample, tmp_path / "verdict"),),
        "its counts are not of the cameras": (edited(of_sample, tmp_path / "counts"),),
    }
    for message, arguments in cases.items():
        code, out, err = call("report", *arguments)
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert message in err
    assert not list(tmp_path.rglob("report.html"))


@dataclass(frozen=True)
class Seen:
    """What a browser made of a page."""

    errors: list[str]
    requests: list[str]
    picture: np.ndarray


def browser() -> str:
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next(filter(None, map(shutil.which, names)), None)
    if found is None:
        pytest.skip("no chromium on the PATH: install Debian's chromium to run this")
    return found


def opened(page: Path, folder: Path, width: int = 1280) -> Seen:
    """Open a page without a network; errors are the console's, requests those that it makes."""
    log, picture = folder / "net.json", folder / f"{page.stem}.png"
    done = subprocess.run(
        [
            browser(), "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--enable-logging=stderr", "--v=0", "--virtual-time-budget=3000",
            "--host-resolver-rules=MAP * ~NOTFOUND", f"--user-data-dir={folder / 'profile'}",
            f"--log-net-log={log}", f"--screenshot={picture}", f"--window-size={width},2000",
            page.as_uri(),
        ],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    events = [event.get("params", {}) for event in json.loads(log.read_text())["events"]]
    # What the browser asks for itself (updates, the time) has no origin.
    asked = [e["url"] for e in events if e.get("initiator", "not an origin") != "not an origin"]
    image = cv2.imread(str(picture))
    assert image is not None
    return Seen(re.findall(r".*CONSOLE.*", done.stderr), asked, image)


def test_a_browser_opens_it_without_errors_and_without_a_network(
    of_sample: Calibration, tmp_path: Path
) -> None:
    page = write_report(of_sample, tmp_path / "report.html")
    for width in (1280, 500):
        seen = opened(page, tmp_path, width)
        assert seen.errors == []
        assert seen.requests == []
        assert seen.picture.shape[1] == width
        green = (seen.picture[:400, :60] == (0x3F, 0x61, 0)).all(axis=2)  # BGR: PASS
        assert green.sum() > 500
        assert seen.picture[400:].std() > 20  # not blank: the overlays


def test_the_browser_would_have_told(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text("<img src='http://nowhere.invalid/x.png'><script>console.error(1)</script>")
    seen = opened(page, tmp_path)
    assert len(seen.errors) == 1
    assert seen.requests == ["http://nowhere.invalid/x.png"]


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["kitti_odometry/sequences/00", "surround6"])
def test_real_recordings_are_reported(realdata: Path, name: str, tmp_path: Path) -> None:
    guess = perturb(calibgraph.load_rig(realdata / name), rotation_deg=1, translation_m=0.1)
    result = calibgraph.calibrate(realdata / name, guess)
    text = page_of(result, tmp_path)
    assert text.count("data:image/jpeg") == 4 * len(result.rig.cameras)
    seen = opened(tmp_path / "report.html", tmp_path)
    assert (seen.errors, seen.requests) == ([], [])


def test_the_template_is_part_of_the_package() -> None:
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert "calibgraph*" in setuptools["packages"]["find"]["include"]
    assert setuptools["package-data"]["calibgraph.report"] == ["page.html.j2"]
