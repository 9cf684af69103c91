"""The page in Chromium: pairs land where they are clicked, with the mouse and with keys alone."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import Rig, evaluate, load_dataset, load_rig, perturb
from calibgraph.model.geometry import twist_between
from calibgraph.service.pick.views import VisiblePoints
from calibgraph.service.pick.workspace import Workspace
from tests.conftest import SAMPLE
from tests.service.pick.builders import project
from tests.service.pick.serving import serving

sync_api = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")
CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
]

PHONE = {"width": 390, "height": 844}
DESK = {"width": 1280, "height": 800}
CAMERA = "front_left"
MARGIN_PX = 30  # of the image, at which a pair may be picked
_DRIVER = "GL Driver Message"  # of software rendering, not of the page


class Picker:
    """A person at the page who knows the truth.

    Attributes:
        page: of the browser.
        workspace: of the server.
        truth: where the points really are in the images.
        messages: of the page's console.
    """

    def __init__(self, page: Any, url: str, workspace: Workspace, truth: Rig) -> None:
        self.page, self.workspace, self.truth = page, workspace, truth
        self.messages: list[str] = []
        page.on("console", lambda message: self.messages.append(message.text))
        page.on("pageerror", lambda error: self.messages.append(str(error)))
        page.goto(f"{url}/pick")
        page.locator("#status", has_not_text="Loading.").wait_for()
        self.rest()

    @property
    def errors(self) -> list[str]:
        return [text for text in self.messages if _DRIVER not in text]

    def rest(self) -> None:
        self.page.evaluate("calibgraphPick.rest()")

    def show(self, frame: int) -> None:
        self.page.select_option("#frame", str(frame))
        self.rest()

    def candidates(self, frame: int, camera: str) -> tuple[np.ndarray, np.ndarray]:
        """Rows of points that are shown now, and where they really are in the image."""
        rows = self._visible(frame, camera).rows
        pixels = project(self.truth, camera, self.workspace.cloud(frame)[rows, :3].astype(float))
        size = np.array([self.truth.cameras[camera].width_px, self.truth.cameras[camera].height_px])
        inside = ((pixels > MARGIN_PX) & (pixels < size - MARGIN_PX)).all(axis=1)
        return rows[inside], pixels[inside]

    def click(self, pixel: np.ndarray) -> None:
        """Zoom in there, and click."""
        self.page.focus("#image")
        self.page.keyboard.press("0")
        self.page.mouse.move(*self._place(pixel))
        self.page.mouse.wheel(0, -900)
        self.rest()
        self.page.mouse.click(*self._place(pixel))
        self.rest()

    def shown_at(self, frame: int, camera: str, row: int) -> np.ndarray:
        """Where the page shows a point now."""
        seen = self._visible(frame, camera)
        return np.asarray(seen.pixels_px[np.flatnonzero(seen.rows == row)[0]])

    def _visible(self, frame: int, camera: str) -> VisiblePoints:
        estimated = self.page.locator("#pose").input_value() == "estimate"
        return self.workspace.visible(frame, camera, estimated=estimated)

    def _place(self, pixel: np.ndarray) -> list[float]:
        place: list[float] = self.page.evaluate(
            "pixel => calibgraphPick.imagePlace(pixel)", [float(value) for value in pixel]
        )
        return place


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture
def picker(browser: Any, tmp_path: Path) -> Iterator[Picker]:
    workspace = Workspace(load_dataset(SAMPLE), tmp_path / "session")
    with serving(workspace) as url:
        truth = load_rig(SAMPLE / "reference.yaml")
        yield Picker(browser.new_page(viewport=DESK), url, workspace, truth)


def test_twelve_pairs_of_two_frames_give_the_reference(picker: Picker, tmp_path: Path) -> None:
    rng, wanted = np.random.default_rng(0), []
    for number in range(12):
        frame = number % 2
        if number:
            picker.show(frame)
        rows, pixels = picker.candidates(frame, CAMERA)
        one = int(rng.integers(len(rows)))
        picker.click(pixels[one])
        picker.click(picker.shown_at(frame, CAMERA, int(rows[one])))
        wanted.append((frame, int(rows[one]), pixels[one]))
    pairs = picker.workspace.session.pairs
    assert [(pair.frame, pair.point_index) for pair in pairs] == [each[:2] for each in wanted]
    away = [np.hypot(*(pair.pixel_px - each[2])) for pair, each in zip(pairs, wanted, strict=True)]
    assert max(away) < 0.5
    picker.page.click("#write")
    picker.rest()
    assert "reference.yaml (front_left)" in picker.page.inner_text("#written")
    found = load_rig(tmp_path / "session" / "reference.yaml")
    error = evaluate(found, picker.truth).cameras[CAMERA]
    assert error.rotation_error_deg < 0.1
    assert error.translation_error_cm < 3.0
    covariance = found.cameras[CAMERA].covariance
    assert covariance is not None
    xi = twist_between(found.T_camera_lidar[CAMERA], picker.truth.T_camera_lidar[CAMERA])
    assert xi @ np.linalg.solve(covariance, xi) < 22.5  # 0.1 % of chi-square with six
    assert picker.errors == []


def test_a_point_is_taken_from_the_cloud(picker: Picker) -> None:
    picker.page.select_option("#source", "cloud")
    rows, pixels = picker.candidates(0, CAMERA)
    picker.click(pixels[0])
    x, y = picker.page.evaluate("row => calibgraphPick.cloudPlace(row)", int(rows[0]))
    picker.page.mouse.click(x, y)
    picker.rest()
    (pair,) = picker.workspace.session.pairs
    cloud = picker.workspace.cloud(0)
    apart = np.linalg.norm(cloud[pair.point_index, :3] - cloud[int(rows[0]), :3])
    spacing = np.sort(np.linalg.norm(cloud[:, :3] - cloud[int(rows[0]), :3], axis=1))[5]
    assert apart <= spacing  # the one that was meant, or the one that hides it from there
    assert picker.errors == []


def test_keys_alone_make_a_pair_take_it_back_and_write(picker: Picker, tmp_path: Path) -> None:
    press = picker.page.keyboard.press
    picker.page.keyboard.press("Tab")
    for _ in range(40):
        if picker.page.evaluate("document.activeElement.id") == "image":
            break
        press("Tab")
    press("ArrowRight")
    press("Shift+ArrowDown")
    press("Alt+ArrowLeft")
    press("Enter")
    picker.rest()
    press("ArrowUp")
    press("ArrowUp")
    press("Enter")
    picker.rest()
    (pair,) = picker.workspace.session.pairs
    middle = np.round(np.array([640, 360]) / 2)
    np.testing.assert_allclose(pair.pixel_px, middle + [0.9, 10.0], atol=1e-6)
    press("u")
    picker.rest()
    assert picker.workspace.session.pairs == ()
    press("r")
    picker.rest()
    assert picker.workspace.session.pairs == (pair,)
    press("s")
    picker.rest()
    assert "pick at least 4" in picker.page.inner_text("#problem")
    assert not (tmp_path / "session" / "reference.yaml").exists()


def test_the_session_is_there_after_the_server_was_started_anew(
    browser: Any, picker: Picker, tmp_path: Path
) -> None:
    rows, pixels = picker.candidates(0, CAMERA)
    picker.click(pixels[7])
    picker.click(picker.shown_at(0, CAMERA, int(rows[7])))
    workspace = Workspace(load_dataset(SAMPLE), tmp_path / "session")
    with serving(workspace) as url:
        again = Picker(browser.new_page(viewport=DESK), url, workspace, picker.truth)
        assert again.page.locator("#pairs tbody tr").count() == 1
        assert workspace.session.pairs == picker.workspace.session.pairs


@pytest.mark.parametrize("size", [PHONE, DESK], ids=["phone", "desk"])
def test_the_page_is_readable_and_fits(picker: Picker, size: Any, tmp_path: Path) -> None:
    picker.page.set_viewport_size(size)
    for frame, row in ((0, 3), (0, 400), (0, 800), (0, 1200), (0, 1600)):
        rows, pixels = picker.candidates(frame, CAMERA)
        picker.click(pixels[row % len(rows)])
        picker.click(picker.shown_at(frame, CAMERA, int(rows[row % len(rows)])))
    picker.page.screenshot(path=tmp_path / "page.png", full_page=True)
    found = axe.Axe().run(picker.page, options={"resultTypes": ["violations"]})
    assert found.violations_count == 0, found.generate_report()
    assert picker.page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    assert picker.errors == []


@pytest.mark.realdata
def test_kitti_is_picked_within_its_error_bars(
    browser: Any, realdata: Path, tmp_path: Path
) -> None:
    """Both cameras, 12 pairs over 2 frames each, clicked with 1 px of noise, 2 degrees off."""
    folder = realdata / "kitti_odometry" / "sequences" / "00"
    truth = load_rig(folder)
    guess = perturb(truth, rotation_deg=2.0, translation_m=0.2, seed=0)
    workspace = Workspace(load_dataset(folder, guess, frames=":2"), tmp_path / "session")
    rng = np.random.default_rng(1)
    with serving(workspace) as url:
        picker = Picker(browser.new_page(viewport=DESK), url, workspace, truth)
        for camera in truth.cameras:
            picker.page.select_option("#camera", camera)
            picker.rest()
            for number in range(12):
                frame = number % 2
                picker.show(frame)
                rows, pixels = picker.candidates(frame, camera)
                one = int(rng.integers(len(rows)))
                picker.click(pixels[one] + rng.standard_normal(2))
                picker.click(picker.shown_at(frame, camera, int(rows[one])))
        picker.page.screenshot(path=tmp_path / "kitti.png", full_page=True)
        picker.page.click("#write")
        picker.rest()
        assert picker.errors == []
    found = evaluate(truth, load_rig(tmp_path / "session" / "reference.yaml"))
    assert found.deviations.keys() == truth.cameras.keys()
    for name, deviation in found.deviations.items():
        assert deviation.p > 1e-3
        assert found.cameras[name].rotation_error_deg < 0.5
        assert found.cameras[name].translation_error_cm < 15.0
    print(found.cameras, {name: each.p for name, each in found.deviations.items()})
