"""The bundle of the page is that of its sources; skipped without node and its packages."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT

WEB = ROOT / "web" / "pick"
STATIC = ROOT / "calibgraph" / "service" / "static" / "pick"

needs_node = pytest.mark.skipif(
    shutil.which("node") is None or not (WEB / "node_modules").is_dir(),
    reason="no node, or not its packages: install node, and run `npm ci` in web/pick",
)


@needs_node
@pytest.mark.slow
def test_the_committed_bundle_is_built_from_the_sources(tmp_path: Path) -> None:
    subprocess.run(["node", WEB / "build.mjs", tmp_path], check=True, timeout=60)
    built = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert built == {path.name: path.read_bytes() for path in STATIC.iterdir()}, "run `make web`"


@needs_node
@pytest.mark.slow
def test_the_sources_have_the_right_types() -> None:
    subprocess.run(["node_modules/.bin/tsc", "--noEmit"], cwd=WEB, check=True, timeout=120)


def test_the_page_loads_nothing_from_elsewhere() -> None:
    page = (STATIC / "index.html").read_text()
    assert "http" not in page
    assert "<style" not in page
    assert "style=" not in page
    assert "<script>" not in page
    assert "eval(" not in (STATIC / "pick.js").read_text()
