"""The pages in Chromium: no errors in its console, contrast, a phone's width, the keyboard."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
import yaml

from calibgraph.service.access import add_token
from calibgraph.service.app import create_app
from calibgraph.service.settings import Settings
from tests.service.conftest import Problem, frames_as_lines

sync_api = pytest.importorskip("playwright.sync_api")
axe = pytest.importorskip("axe_playwright_python.sync_playwright")
CHROMIUM = shutil.which("chromium")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
]

PHONE = {"width": 390, "height": 844}
DESK = {"width": 1280, "height": 900}


@dataclass(frozen=True)
class Filled:
    """A server with jobs and a tracker, on a port.

    Attributes:
        url: of it.
        solved, failed: pages of jobs.
        tracker: page of a tracker that was moved.
    """

    url: str
    solved: str
    failed: str
    tracker: str


@contextmanager
def serving(settings: Settings) -> Iterator[str]:
    """A server on a port; its URL."""
    app = create_app(settings)
    server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="warning"))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.05)
    try:
        yield f"http://127.0.0.1:{server.servers[0].sockets[0].getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory, small: Problem) -> Iterator[Filled]:
    data = tmp_path_factory.mktemp("browser") / "data"
    settings = Settings(data=data, jobs_at_once=1, tracker_processes=1, free_bytes=0)
    with serving(settings) as url, httpx.Client(base_url=url, timeout=120) as http:
        yield fill(http, small)


def fill(http: httpx.Client, small: Problem) -> Filled:
    """Jobs with a result and without, a tracker with an alarm."""
    ids = [
        http.post("/v1/solves", files=files).json()["id"]
        for files in (small.files, {**small.files, "rig": b"cameras: 7"})
    ]
    for id in ids:
        http.get(f"/v1/jobs/{id}", params={"wait_s": 60})
    rig = yaml.safe_load(small.rig)
    at = http.post("/v1/trackers", json={"rig": rig, "name": "car-1"}).headers["location"]
    kind = {"Content-Type": "application/x-ndjson"}
    body = b"".join(frames_as_lines(small.table))
    http.post(f"{at}/frames", content=body, headers=kind).raise_for_status()
    pages = [f"/jobs/{id}" for id in ids]
    return Filled(str(http.base_url), pages[0], pages[1], at.removeprefix("/v1"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.mark.parametrize("size", [PHONE, DESK], ids=["phone", "desk"])
def test_pages_are_clean_readable_and_fit(
    browser: Any, filled: Filled, size: Any, tmp_path: Path
) -> None:
    page = browser.new_page(viewport=size, base_url=filled.url)
    errors: list[str] = []
    page.on("console", lambda message: errors.append(message.text))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("requestfailed", lambda request: errors.append(request.url))
    report = f"/v1{filled.solved}/report.html"
    places = ["/", filled.solved, filled.failed, "/trackers", filled.tracker, "/docs", "/sign-in",
              "/new/calibration", "/new/check", "/new/solve", report]  # fmt: skip
    for place in places:
        page.goto(place, wait_until="networkidle")
        page.screenshot(path=tmp_path / f"{place.strip('/').replace('/', '_')}.png", full_page=True)
        found = axe.Axe().run(page, options={"resultTypes": ["violations"]})
        assert found.violations_count == 0, f"{place}: {found.generate_report()}"
        width = page.evaluate("document.documentElement.scrollWidth")
        assert width <= size["width"], f"{place} is {width} px wide"
    assert errors == []


def test_a_job_is_followed_until_its_result(browser: Any, filled: Filled, small: Problem) -> None:
    page = browser.new_page(viewport=PHONE, base_url=filled.url)
    id = httpx.post(f"{filled.url}/v1/solves", files=small.files).json()["id"]
    page.goto(f"/jobs/{id}")
    page.wait_for_selector(".verdict.PASS", timeout=60_000)
    assert page.locator(".big").inner_text() == "PASS"


@pytest.mark.parametrize("with_scripts", [True, False], ids=["scripts", "none"])
def test_a_form_leads_to_its_job(
    browser: Any, filled: Filled, small: Problem, tmp_path: Path, with_scripts: bool
) -> None:
    (tmp_path / "rig.yaml").write_bytes(small.rig)
    (tmp_path / "table.parquet").write_bytes(small.table)
    page = browser.new_page(base_url=filled.url, java_script_enabled=with_scripts)
    page.goto("/new/solve")
    page.set_input_files("#rig", tmp_path / "rig.yaml")
    page.set_input_files("#correspondences", tmp_path / "table.parquet")
    page.fill("#name", "car 7")
    page.click("text=Start")
    page.wait_for_url("**/jobs/*")
    assert page.locator("h1").inner_text() == "car 7: can this calibration be used?"
    assert page.locator("nav >> text=Jobs").count() == 1


def test_a_refused_form_keeps_its_fields(browser: Any, filled: Filled, tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("cameras: 7")
    page = browser.new_page(base_url=filled.url)
    page.goto("/new/check")
    page.set_input_files("#rig", tmp_path / "rig.yaml")
    page.set_input_files("#recording", tmp_path / "rig.yaml")
    page.fill("#name", "car 7")
    page.fill("#tolerance_deg", "500")
    page.click("text=Start")
    page.wait_for_selector("[role=alert]:not(:empty)")
    assert "tolerance_deg" in page.locator("[role=alert]").inner_text()
    assert page.input_value("#name") == "car 7"


def test_a_browser_signs_in_and_out(browser: Any, tmp_path: Path) -> None:
    """Its forms carry the Origin that the server asks for."""
    tokens = tmp_path / "tokens.yaml"
    secret = add_token(tokens, "ours", "submit")
    settings = Settings(
        data=tmp_path / "data", tokens=tokens, jobs_at_once=0, tracker_processes=0, free_bytes=0
    )
    with serving(settings) as url:
        page = browser.new_page(base_url=url)
        page.goto("/")
        page.wait_for_url("**/sign-in")
        page.fill("#token", secret)
        page.click("main button")
        page.wait_for_url(f"{url}/")
        assert "Which jobs ran" in page.locator("h1").inner_text()
        page.click("header button")
        page.wait_for_url("**/sign-in")


def test_the_keyboard_leads_to_a_job(browser: Any, filled: Filled) -> None:
    page = browser.new_page(viewport=DESK, base_url=filled.url)
    page.goto("/")
    links = page.locator("a").count()
    for _ in range(links):
        page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_url("**/jobs/*")
