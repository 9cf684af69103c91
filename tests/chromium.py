"""Chromium for tests of pages, which are skipped where it is missing."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser of playwright."""
    sync_api = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no chromium: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


def errors_of(page: Any) -> list[str]:
    """What goes to the page's console from now on, and what fails."""
    errors = list[str]()
    page.on("console", lambda message: errors.append(message.text))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("requestfailed", lambda request: errors.append(request.url))
    return errors


def require_accessible(page: Any) -> None:
    """Check it by the rules of axe."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright")
    found = axe.Axe().run(page, options={"resultTypes": ["violations"]})
    assert found.violations_count == 0, found.generate_report()


@dataclass(frozen=True)
class Rendering:
    """A page without a network: its errors, its requests, and a screenshot."""

    page: Any
    errors: list[str]
    requests: list[str]
    picture: np.ndarray


def render(browser: Any, file: Path, width: int = 1280) -> Rendering:
    """Open a file without a network."""
    page = browser.new_page(viewport={"width": width, "height": 2000}, offline=True)
    errors, requests = errors_of(page), list[str]()
    page.on("request", lambda request: requests.append(request.url))
    page.goto(file.as_uri(), wait_until="networkidle")
    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    fetched = [url for url in requests if url != file.as_uri() and not url.startswith("data:")]
    return Rendering(page, errors, fetched, picture)
