"""The page in a browser: no errors, no requests, something to see."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

import calibgraph
from calibgraph import Calibration, perturb
from tests.conftest import CommandRun
from tests.report.conftest import write_page


@dataclass(frozen=True)
class Rendering:
    """A browser's errors on its console, the requests of the page, and a screenshot."""

    errors: list[str]
    requests: list[str]
    picture: np.ndarray


def browser() -> str:
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("no chromium on the PATH: install Debian's chromium to run this")
    return path


def render(page: Path, folder: Path, width: int = 1280) -> Rendering:
    """Open a page without a network."""
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
    # The browser's own requests (updates, the time) have no origin.
    requests = [e["url"] for e in events if e.get("initiator", "not an origin") != "not an origin"]
    image = cv2.imread(str(picture))
    assert image is not None
    return Rendering(re.findall(r".*CONSOLE.*", done.stderr), requests, image)


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
    sample_result: Calibration, tmp_path: Path
) -> None:
    """The way of a knob 16 px wide is the width of the picture."""
    script = """<script>addEventListener("load", () => {
      const box = document.querySelector(".overlays");
      const way = box.querySelector("input[type=range]").getBoundingClientRect();
      const picture = box.querySelector(".pair").getBoundingClientRect();
      document.title = [way.left + 8 - picture.left, way.right - 8 - picture.right].join(" ");
    });</script>"""
    page = tmp_path / "page.html"
    page.write_text(write_page(sample_result, tmp_path).replace("</body>", f"{script}</body>"))
    command = [browser(), "--headless", "--no-sandbox", "--disable-gpu", "--window-size=1280,2000",
               f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri()]  # fmt: skip
    dom = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout
    (title,) = re.findall(r"<title>([^<]*)</title>", dom)
    assert [abs(float(number)) < 0.5 for number in title.split()] == [True, True]
