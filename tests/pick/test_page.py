"""The page in Chromium: pairs land where they are clicked, by mouse and by keys."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import Rig, load_dataset, load_rig
from calibgraph.pick.server import PickServer, Workspace
from tests.chromium import errors_of, require_accessible
from tests.conftest import SAMPLE

pytestmark = pytest.mark.slow
MARGIN_PX = 40  # of the image, at which a pair may be picked


class Picker:
    """A person at the page who knows the truth, and clicks with some noise."""

    def __init__(self, page: Any, server: PickServer, truth: Rig) -> None:
        self.page, self.workspace, self.truth = page, server.workspace, truth
        self.errors = errors_of(page)
        page.goto(server.url)
        page.wait_for_function("globalThis.calibgraphPick")
        self.rest()

    def rest(self) -> None:
        self.page.evaluate("calibgraphPick.rest()")

    def choose(self, camera: str, frame: int) -> None:
        for name, value in (("camera", camera), ("frame", str(frame))):
            if self.page.locator(f"#{name}").input_value() != value:
                self.page.select_option(f"#{name}", value)
                self.rest()

    def draw(self, rng: np.random.Generator, camera: str, frame: int) -> tuple[Any, Any]:
        """A point of the cloud, and where it really is in the image."""
        seen, points = self.truth.cameras[camera], self.workspace.cloud(frame)[:, :3].astype(float)
        T, distance_m = seen.T_camera_lidar, np.linalg.norm(points, axis=1)
        pixels, valid = seen.lens.project(points @ T[:3, :3].T + T[:3, 3])
        size = np.array([seen.width_px, seen.height_px])
        inside = ((pixels > MARGIN_PX) & (pixels < size - MARGIN_PX)).all(axis=1)
        one = rng.choice(np.flatnonzero(valid & inside & (distance_m > 4) & (distance_m < 35)))
        return points[one], pixels[one]

    def click(self, canvas: str, place: str, at: Any) -> None:
        """Show all, zoom in there, and click."""
        self.page.focus(f"#{canvas}")
        self.page.keyboard.press("0")
        box = self.page.locator(f"#{canvas}").bounding_box()
        for turns in (400, 400, -900):  # out, until it is in view, then in
            x, y = self.page.evaluate(f"at => calibgraphPick.{place}(...at)", at.tolist())
            where = (box["x"] + x, box["y"] + y)
            if not (0 < x < box["width"] and 0 < y < box["height"]):
                where = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
            elif turns > 0:
                continue
            self.page.mouse.move(*where)
            self.page.mouse.wheel(0, turns)
        x, y = self.page.evaluate(f"at => calibgraphPick.{place}(...at)", at.tolist())
        self.page.mouse.click(box["x"] + x, box["y"] + y)

    def pick(self, camera: str, count: int, noise_px: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        frames = [f.index for f in self.workspace.dataset.frames if camera in f.image_paths]
        for number in range(count):
            self.choose(camera, frames[number % len(frames)])
            point, pixel = self.draw(rng, camera, frames[number % len(frames)])
            self.click("image", "imagePlace", pixel + noise_px * rng.standard_normal(2))
            self.click("cloud", "cloudPlace", point)
            self.rest()


@pytest.fixture
def open_page(browser: Any, tmp_path: Path) -> Iterator[Any]:
    servers = []

    def open_with(data: Path, truth: Rig, guess: Rig) -> Picker:
        server = PickServer(Workspace(load_dataset(data, guess), tmp_path), 0)
        servers.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        return Picker(page, server, truth)

    yield open_with
    for server in servers:
        server.shutdown()
        server.server_close()


def test_pairs_land_where_they_are_clicked_and_give_the_reference(
    open_page: Any, tmp_path: Path
) -> None:
    truth = load_rig(SAMPLE / "reference.yaml")
    picker = open_page(SAMPLE, truth, load_rig(SAMPLE))
    picker.pick("front_left", 7, 0.0, 0)
    pairs, page = picker.workspace.session.pairs, picker.page
    camera = truth.cameras["front_left"]
    T = camera.T_camera_lidar
    for pair in pairs:
        point = T[:3, :3] @ np.array(pair.point_lidar_m) + T[:3, 3]
        pixels, _ = camera.lens.project(point[None])
        # A click is known to a screen's pixel, a ninth of the image's; beside a point that is
        # drawn over another a neighbour is taken.
        assert np.linalg.norm(pixels[0] - pair.pixel_px) < 3
    assert "1 sigma about and along" in page.locator("#estimate").text_content()
    page.click("text=Undo")
    picker.rest()
    assert len(picker.workspace.session.pairs) == 6
    page.get_by_label("Remove pair 1", exact=True).click()
    picker.rest()
    assert "5 of 6 pairs" in page.locator("#estimate").text_content()
    page.click("#write")
    picker.rest()
    assert "determine no camera yet" in page.locator("#status").text_content()
    assert not (tmp_path / "reference.yaml").exists()
    assert [text for text in picker.errors if "400" not in text] == []


def test_the_keyboard_alone_makes_a_pair_and_the_page_is_accessible(
    open_page: Any,
) -> None:
    picker = open_page(SAMPLE, load_rig(SAMPLE / "reference.yaml"), load_rig(SAMPLE))
    picker.page.focus("#image")
    picker.page.keyboard.press("ArrowRight")
    picker.page.keyboard.press("Enter")
    picker.page.focus("#cloud")
    point, _ = picker.draw(np.random.default_rng(0), "front_left", 0)
    box = picker.page.locator("#cloud").bounding_box()
    x, y = picker.page.evaluate("at => calibgraphPick.cloudPlace(...at)", point.tolist())
    across, down = round(x - box["width"] / 2), round(y - box["height"] / 2)
    for steps, ahead, back in ((across, "ArrowRight", "ArrowLeft"), (down, "ArrowDown", "ArrowUp")):
        for _ in range(abs(steps)):
            picker.page.keyboard.press(ahead if steps > 0 else back)
    picker.page.keyboard.press("Enter")
    picker.rest()
    (pair,) = picker.workspace.session.pairs
    assert np.linalg.norm(np.array(pair.point_lidar_m) - point) < 3
    require_accessible(picker.page)
