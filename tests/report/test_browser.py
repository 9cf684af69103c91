"""The page in a browser: no errors, no requests, something to see."""

from __future__ import annotations

from pathlib import Path

import pytest

import calibgraph
from calibgraph import perturb
from tests.conftest import CommandRun
from tests.report.browsing import render
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
