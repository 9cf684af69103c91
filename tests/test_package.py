from __future__ import annotations

import tomllib

from tests.conftest import ROOT


def test_every_file_of_the_packages_is_installed() -> None:
    """What is not Python has to be named, or it is in a checkout alone."""
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    installed = {
        path
        for package, patterns in setuptools["package-data"].items()
        for pattern in patterns
        for path in (ROOT / package.replace(".", "/")).glob(pattern)
    }
    held = {
        path
        for package in ("calibgraph", "factors")
        for path in (ROOT / package).rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc")
    }
    assert held - installed == set()
    assert len(held) > 5
