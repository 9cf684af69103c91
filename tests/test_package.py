from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

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


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "name", ["factors", *(pytest.param(n, marks=SLOW) for n in ("numpy", "typer", "yaml"))]
)
def test_run_as_a_module_it_imports_nothing_from_the_working_folder(
    name: str, tmp_path: Path
) -> None:
    (tmp_path / f"{name}.py").write_text("raise SystemExit('imported')")
    done = subprocess.run(
        [sys.executable, "-m", "calibgraph", "evaluate", "nothing.yaml", "nothing.yaml"],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.startswith("calibgraph: nothing.yaml") and done.stderr.count("\n") == 1
