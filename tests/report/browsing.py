"""Pages as a browser shows them."""

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
        pytest.skip("no chromium: apt-get install chromium")
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
