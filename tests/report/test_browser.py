"""The page in a browser: no errors, no requests, something to see."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

import calibgraph
from calibgraph import perturb
from tests.conftest import CommandRun
from tests.report.browsing import browser, render
from tests.report.conftest import write_page


def test_a_browser_shows_it_without_errors_and_without_a_network(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    page = calibrated_sample.folder / "report.html"
    for width in (1280, 500):
        rendering = render(page, tmp_path, width)
        assert rendering.errors == []
        assert rendering.requests == []
        assert rendering.picture.shape[1] == width
        green = (rendering.picture[:400, :60] == (0x3F, 0x61, 0)).all(axis=2)  # BGR: PASS
        assert green.sum() > 500
        assert rendering.picture[400:].std() > 20  # not blank: the overlays


def test_the_browser_reports_errors_and_requests(tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text("<img src='http://nowhere.invalid/x.png'><script>console.error(1)</script>")
    rendering = render(page, tmp_path)
    assert len(rendering.errors) == 1
    assert rendering.requests == ["http://nowhere.invalid/x.png"]


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["kitti_odometry/sequences/00", "surround6"])
def test_real_recordings_are_reported(realdata: Path, name: str, tmp_path: Path) -> None:
    guess = perturb(calibgraph.load_rig(realdata / name), rotation_deg=1, translation_m=0.1)
    result = calibgraph.calibrate(realdata / name, guess)
    text = write_page(result, tmp_path)
    pairs = 0 if result.camera_matches is None else len(result.camera_matches.pairs())
    assert text.count("data:image/jpeg") == 4 * len(result.rig.cameras) + pairs
    rendering = render(tmp_path / "report.html", tmp_path)
    assert (rendering.errors, rendering.requests) == ([], [])


def test_the_knob_of_the_slider_is_above_the_line(
    calibrated_sample: CommandRun, tmp_path: Path
) -> None:
    """The way of a knob 16 px wide is the width of the picture."""
    script = """<script>addEventListener("load", () => {
      const box = document.querySelector(".overlays");
      const way = box.querySelector("input[type=range]").getBoundingClientRect();
      const picture = box.querySelector(".pair").getBoundingClientRect();
      document.title = [way.left + 8 - picture.left, way.right - 8 - picture.right].join(" ");
    });</script>"""
    page = tmp_path / "page.html"
    text = (calibrated_sample.folder / "report.html").read_text("utf-8")
    page.write_text(text.replace("</body>", f"{script}</body>"))
    command = [browser(), "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1280,2000",
               f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri()]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    (title,) = re.findall(r"<title>([^<]*)</title>", dom)
    assert [abs(float(number)) < 0.5 for number in title.split()] == [True, True]
