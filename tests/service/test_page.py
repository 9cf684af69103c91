"""The page in Chromium: nothing in its console, contrast, a phone's width, the token."""

from collections.abc import Iterator
from typing import Any

import pytest

from calibgraph.service.request_guard import add_token
from tests.chromium import errors_of, require_accessible
from tests.service.conftest import ONE_EACH, Problem, bearer
from tests.service.serving import Server

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, small: Problem) -> Iterator[tuple[str, str]]:
    """A server with jobs of all states, and a token of it."""
    folder = tmp_path_factory.mktemp("page")
    token = add_token(folder / "tokens")
    server = Server(folder / "data", *ONE_EACH, "--tokens", str(folder / "tokens"))
    server.start()
    server.http.headers.update(bearer(token))
    about = {"name": "car 7 <b>"}
    wrong = {**small.files, "rig": b"cameras: 7"}
    for files, data in ((small.files, about), (wrong, {}), (small.files, {})):
        at = server.http.post("/v1/jobs/solve", files=files, data=data).headers["location"]
        server.wait_for(at)
    yield str(server.http.base_url), token
    server.http.close()
    server.end(9)


@pytest.mark.parametrize("size", [(390, 844), (1280, 900)], ids=["phone", "desk"])
def test_the_page_is_clean_readable_and_leads_to_reports(
    browser: Any, served: tuple[str, str], size: tuple[int, int]
) -> None:
    url, token = served
    page = browser.new_page(
        viewport={"width": size[0], "height": size[1]},
        http_credentials={"username": "", "password": token},
    )
    errors = errors_of(page)
    page.goto(url, wait_until="networkidle")
    assert page.locator("text=car 7 <b>").count() == 1
    assert page.locator(".badge.PASS").count() == 2
    for _ in range(2):
        require_accessible(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
        page.click("text=Report >> nth=0") if page.url.endswith("/") else None
    assert page.url.endswith("/report.html")
    assert errors == []
